"""The demands under way: their states, with a method for each change of state.

| state | the demand | next |
| --- | --- | --- |
| arrived | was submitted | queued, done |
| queued | is in the journal and may be evaluated | committed, proposed, withdrawn, done |
| committed | has a commit, and can no longer be withdrawn | committed, proposed, done |
| proposed | awaits a person's approval | proposed, queued, withdrawn, done |
| withdrawn | was taken back, given up, released or replaced | done |
| done | is answered | |

A method that changes a state holds one lock while it writes to the journal, changes the state and
wakes the worker. So two threads cannot commit and withdraw a demand at the same time. Any thread
may submit or withdraw a demand. A thread of its own journals the demands that arrive, even while
the worker publishes other demands. Whoever takes or withdraws demands, or closes the queue, also
journals what has arrived. The worker's thread makes all other changes of state.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Collection, Hashable, Iterable, Sequence
from dataclasses import replace
from datetime import datetime
from operator import attrgetter

from demandops.base import errors
from demandops.base.errors import DemandOpsError, InvalidInput
from demandops.base.quoting import quoted
from demandops.base.runtime import Runtime, log
from demandops.serve.journal import Journal, ProposalRecord, Receipt, Ticket, TicketState

# ---- the queue of demands: requesters take turns, and related demands keep their order ----
#
# A demand counts only for its first requester. If another queued demand must stay ahead of the
# demand whose turn it is, the queue returns the other demand first.
#
# - Demands that share an application, a connection or a demand id keep their order.
# - A rollback or a decommission may touch any subject, so it overtakes no demand, and no demand
#   overtakes it.

_NUMBER = attrgetter("number")
_Line = OrderedDict[Ticket, None]  # a set in order, which loses any member at once


class FairQueue:
    # Not thread-safe. With ``in_order``, demands leave in the order of their arrival, and
    # requesters take no turns.

    def __init__(self, *, in_order: bool = False) -> None:
        self._in_order = in_order
        self._queued = OrderedDict[Ticket, None]()
        # The lines in which the demands stand: of their requesters, and of what they touch, where
        # None is the line of those that may touch anything. No line is empty.
        self._lanes = OrderedDict[Hashable, _Line]()
        self._subjects: dict[Hashable, _Line] = {}
        self._arrived = 0

    def __len__(self) -> int:
        return len(self._queued)

    def append(self, ticket: Ticket) -> None:
        self._arrived += 1
        ticket.number, ticket.subjects = self._arrived, ticket.demand.touches()
        self._queued[ticket] = None
        for lines, key in self._places(ticket):
            lines.setdefault(key, OrderedDict())[ticket] = None

    def put_back(self, tickets: Sequence[Ticket], served: Iterable[Ticket] = ()) -> None:
        # In the order in which they left, each before others of its requester. Their requesters get
        # the next turns. But a requester of ``served``, demands that left with them and do not come
        # back, had its turn and comes after all others.
        number = next(iter(self._queued)).number if self._queued else 1
        for ticket in reversed(tickets):
            number -= 1
            ticket.number = number
            self._queued[ticket] = None
            self._queued.move_to_end(ticket, last=False)
            lane, *subjects = self._places(ticket)
            for lines, key in (lane, *subjects):
                lines.setdefault(key, OrderedDict())[ticket] = None
                lines[key].move_to_end(ticket, last=False)
            self._lanes.move_to_end(lane[1], last=False)
        for requester in dict.fromkeys(ticket.requester for ticket in served):
            if requester in self._lanes:
                self._lanes.move_to_end(requester)

    def remove(self, tickets: Iterable[Ticket]) -> None:
        for ticket in tickets:
            if ticket in self._queued:
                del self._queued[ticket]
                for lines, key in self._places(ticket):
                    del lines[key][ticket]
                    if not lines[key]:  # many ids come only once; keep none of them
                        del lines[key]

    def popleft(self) -> Ticket:
        requester, lane = next(iter(self._lanes.items()))
        self._lanes.move_to_end(requester)  # so that the other requesters come first
        before, first = next(iter(lane)), None
        # whoever has the turn, related demands leave in the order in which they came
        while before is not first:
            first = before
            lines = [self._queued]
            if first.subjects is not None:
                touched = (*first.subjects, None)
                lines = [self._subjects[each] for each in touched if each in self._subjects]
            before = min([first, *(next(iter(line)) for line in lines)], key=_NUMBER)
        self.remove([before])
        return before

    def _places(self, ticket: Ticket) -> list[tuple[dict[Hashable, _Line], Hashable]]:
        subjects = (None,) if ticket.subjects is None else ticket.subjects
        lane = "" if self._in_order else ticket.requester
        return [(self._lanes, lane), *((self._subjects, subject) for subject in subjects)]


# ---- whether the remote can be reached, for logs, diagnostics and refusals ----


class Remote:
    # any thread may read the fields

    unreachable = ""  # why the remote cannot be read or written now
    push_denied = ""  # why the remote, which can be read, takes no push
    unreachable_since: datetime | None = None
    last_reached: datetime | None = None
    last_push: datetime | None = None
    # by the monotonic clock, as a person may set the other one
    _away_from = _denied_from = 0.0

    def __init__(self, address: str, runtime: Runtime) -> None:
        self._address, self._runtime = address, runtime

    @property
    def blocked(self) -> str:
        return self.unreachable or self.push_denied

    def record_reached(self, *, pushed: bool = False) -> None:
        self.last_reached = self._runtime.now()
        if self.unreachable:
            away = self._runtime.monotonic() - self._away_from
            log.info("%s is back after %.0f s", self._address, away)
            self.unreachable, self.unreachable_since = "", None
        if pushed:
            self.push_denied, self.last_push = "", self.last_reached

    def record_failure(self, reason: str, *, is_denied: bool = False) -> float:
        """Return for how many seconds the remote, which can be read, has denied all pushes."""
        now, known = self._runtime.monotonic(), self.unreachable
        if is_denied:
            self.record_reached()
            known, self.push_denied = self.push_denied, reason
            self._denied_from = self._denied_from if known else now
        else:
            self._away_from = self._away_from if known else now
            self.unreachable_since = self.unreachable_since or self._runtime.now()
            self.unreachable = reason
        if known:
            log.debug("%s", reason)
        elif is_denied:
            log.error("%s", reason)
        else:
            log.warning("%s; trying again until the state repo is back", reason)
        return now - self._denied_from if is_denied else 0.0


# ---- the states of the demands ----

TAKEN_BACK = "the demand was taken back before it was committed"
GIVEN_UP = "the demand was given up by `demandops journal --drop`"
# The seconds between two looks for such requests.
_LOOK_S = 1.0

_NEXT: dict[TicketState, tuple[TicketState, ...]] = {
    "arrived": ("queued", "done"),
    "queued": ("committed", "proposed", "withdrawn", "done"),
    "committed": ("committed", "proposed", "done"),
    "proposed": ("proposed", "queued", "withdrawn", "done"),
    "withdrawn": ("done",),
    "done": (),
}


class Demands:
    def __init__(
        self,
        journal: Journal,
        limit: int,
        requester_limit: int | None,
        remote: Remote,
        runtime: Runtime,
    ) -> None:
        self._journal, self.remote = journal, remote
        # The limit of a requester does not count demands that await approval: a person takes days.
        self._limit, self._requester_limit = limit, requester_limit
        self._of_requester = Counter[str]()
        self._changed = runtime.condition()
        self._arrived = deque[Ticket]()
        self._arrival = runtime.event()
        self._new: list[Ticket] = []
        self._queue = FairQueue(in_order=requester_limit is None)
        for ticket in journal.pending.values():
            log.info("resuming demand %s from the journal", ticket.operation)
            if ticket.proposal is None:
                self._enqueue(ticket)
        self.is_closed = self._woken = False
        self._give_up_what_is_dropped()  # before the worker begins

    # ---- queries ----

    @property
    def proposed(self) -> list[Ticket]:
        """The demands of all proposals; a new one may not be on its branch yet."""
        with self._changed:
            return [ticket for ticket in self._journal.pending.values() if ticket.proposal]

    @property
    def unpublished(self) -> int:
        """The number of demands still to publish: those in the journal that await no approval."""
        with self._changed:
            return sum(not ticket.proposal for ticket in self._journal.pending.values())

    @property
    def has_queued(self) -> bool:
        return bool(self._arrived or self._queue)

    # ---- waiting for demands ----

    def close(self) -> None:
        """Accept no further demands; the demands that have arrived are still carried out."""
        self._take_in()  # what came before is accepted
        with self._changed:
            self.is_closed = True
            self._changed.notify()
        self._take_in()  # what came between the two is refused; no thread would look at it again
        self._arrival.set()

    def wake(self) -> None:
        with self._changed:
            self._woken = True
            self._changed.notify()

    def wait(self, timeout: float | None) -> bool:
        """Wait for a demand, :meth:`wake` or :meth:`close`; false once no demand will come."""
        with self._changed:
            if not (self._woken or self.is_closed or self.has_queued):
                self._changed.wait(timeout)
            self._woken = False
            return self.has_queued or not self.is_closed

    def new_demands(self, timeout: float) -> list[Ticket]:
        """Return the demands accepted since this or :meth:`take` was called; wait if none is."""
        with self._changed:
            if not (self._woken or self._new):
                self._changed.wait(timeout)
            self._woken = False
            # after a failed write the state of the journal is unknown, so the process must end
            self._journal.require_sound()
            new, self._new = self._new, []
            return new

    def take(self, batch: list[Ticket], limit: int) -> None:
        self._take_in()
        with self._changed:
            self._journal.require_sound()
            self._new.clear()
            batch[:] = [ticket for ticket in batch if ticket.state != "done"]
            room = min(limit - len(batch), len(self._queue))
            batch += [self._queue.popleft() for _ in range(room)]

    def put_back(self, batch: list[Ticket], served: Collection[Ticket]) -> None:
        # The next batch takes turns between these demands and those that others sent meanwhile. The
        # requesters of ``served``, the demands that were evaluated, come last.
        with self._changed:
            self._queue.put_back([each for each in batch if each.state != "done"], served)
            batch.clear()

    # ---- changes of state ----

    def arrive(self, ticket: Ticket) -> None:
        # No lock and no journal here: the caller answers ROS clients and must not wait for an
        # fsync. The thread of `journal_arrivals` takes the demand in.
        ticket.state = "arrived"
        self._arrived.append(ticket)
        self._arrival.set()
        if self.is_closed:  # that thread may have ended, so refuse the demand here
            self._take_in()

    def journal_arrivals(self) -> None:
        # demands that arrive during an fsync of the journal share the next fsync
        while not self.is_closed:
            self._arrival.wait(_LOOK_S)
            self._arrival.clear()
            self._take_in()
            self._give_up_what_is_dropped()

    def _take_in(self) -> None:  # noqa: PLR0912
        if not self._arrived:
            return
        taken, refused = dict[str, Ticket](), list[tuple[Ticket, DemandOpsError]]()
        with self._changed:
            for _ in range(len(self._arrived)):
                ticket = self._arrived.popleft()
                who, operation = ticket.requester, ticket.operation
                if self.is_closed:
                    why = "the generator is shutting down; send the demand again later"
                    refused.append((ticket, errors.ShuttingDown(why)))
                # those taken just before are not queued yet
                elif len(taken) + len(self._queue) >= self._limit:
                    blocked = self.remote.blocked
                    # this needs another remedy than a client that sends too much
                    why = f" and cannot be published ({blocked})" if blocked else ""
                    why = f"{self._limit} demands are queued already{why}; "
                    refused.append((ticket, errors.QueueFull(f"{why}send the demand again later")))
                elif operation in self._journal.pending or operation in taken:
                    why = f"'{operation}' is the operation id of another demand; choose a new one"
                    refused.append((ticket, errors.Refused.at("", why)))
                elif self._requester_limit is not None and (
                    self._of_requester[who] >= self._requester_limit
                ):
                    whose = f"of {quoted(who)}" if who else "without a requester"
                    why = f"{self._requester_limit} demands {whose} have no answer yet; send the "
                    why += "demand again later, or raise the node's parameter requester_queue_limit"
                    refused.append((ticket, errors.QueueFull(why)))
                else:
                    self._of_requester[who] += 1
                    taken[operation] = ticket
            try:
                self._journal.append(taken.values())
            except Exception as failure:
                if isinstance(failure, DemandOpsError):
                    error = failure
                    log.error("%s", error)
                else:  # a bug must leave no demand without an answer
                    error = errors.internal(failure)
                    log.exception("internal error while journaling demands")
                self.wake()  # so that the worker ends the process if the journal is unsound
                for ticket in taken.values():
                    self._of_requester[ticket.requester] -= 1
                    refused.append((ticket, error))
                taken = {}
            for ticket in taken.values():
                _change(ticket, "queued")
                self._queue.append(ticket)
            self._new += taken.values()
            self._changed.notify()
        for ticket in taken.values():
            ticket.journaled.set_result(True)
        for ticket, error in refused:
            ticket.refuse(error)

    def commit(self, ticket: Ticket) -> bool:
        with self._changed:
            return _change(ticket, "committed")

    def propose(self, ticket: Ticket, record: ProposalRecord) -> bool:
        """Journal the proposal of a demand; false if it is withdrawn or answered already."""
        with self._changed:
            if "proposed" not in _NEXT[ticket.state]:
                return False
            was_proposed = ticket.proposal is not None
            self._note(ticket, record)
            if not was_proposed:
                self._of_requester -= Counter([ticket.requester])
            return _change(ticket, "proposed")

    def _note(self, ticket: Ticket, proposal: ProposalRecord | None) -> None:
        before, ticket.proposal = ticket.proposal, proposal
        try:
            self._journal.append([ticket])
        except BaseException:
            ticket.proposal = before
            raise

    def requeue(self, tickets: Iterable[Ticket]) -> None:
        with self._changed:
            for ticket in tickets:
                ticket.mark_maybe_published(ticket.base)  # a person may have merged it meanwhile
                self._note(ticket, None)
                _change(ticket, "queued")
                self._enqueue(ticket)
            self._changed.notify()

    def withdraw(self, operation: str) -> bool:
        self._take_in()
        with self._changed:
            ticket = self._journal.pending.get(operation)
            if ticket is None or "withdrawn" not in _NEXT[ticket.state]:
                return ticket is not None and ticket.state == "withdrawn"
            awaits_approval = ticket.proposal is not None
            try:
                self._withdraw(ticket, TAKEN_BACK)
            # if unsound, the worker ends the process
            except (errors.StateRepoError, errors.Unsound) as error:
                log.error("demand %s cannot be withdrawn: %s", operation, error)
                self.wake()
                return False
        if not awaits_approval:  # else it is answered after its branch is deleted
            self.answer([(ticket, errors.Withdrawn(TAKEN_BACK))])
        return True

    def _give_up_what_is_dropped(self) -> None:
        for request in self._journal.drop_requests():
            with self._changed:
                ticket = self._journal.pending.get(request.name.partition("-")[2])
                if ticket is None:  # it is answered
                    request.unlink()
                    continue
                if ticket.withdrawn:
                    continue
                log.warning("%s: demand %s", GIVEN_UP, ticket.operation)
                # a push of a committed demand may have arrived, so the next attempt answers it
                if ticket.state == "committed":
                    ticket.state, ticket.withdrawn = "withdrawn", GIVEN_UP
                    continue
                awaits_approval = ticket.proposal is not None
                self._withdraw(ticket, GIVEN_UP)
            if not awaits_approval:
                self.answer([(ticket, errors.Withdrawn(GIVEN_UP))])

    def withdraw_proposed(self, tickets: Iterable[Ticket], reason: str) -> None:
        with self._changed:
            for ticket in tickets:
                if ticket.state == "proposed":
                    self._withdraw(ticket, reason)

    def _withdraw(self, ticket: Ticket, reason: str) -> None:
        if ticket.proposal is None:
            # a restart must not resume the withdrawn demand
            self._journal.mark_done([ticket.operation], durably=True)
            self._queue.remove([ticket])
        else:  # the demand stays in the journal until its branch is deleted
            self._note(ticket, replace(ticket.proposal, withdrawn=reason))
            self.wake()
        ticket.withdrawn = reason
        _change(ticket, "withdrawn")

    def answer(
        self, results: Iterable[tuple[Ticket, Receipt | DemandOpsError]], keep: bool = False
    ) -> None:
        """Answer each demand without an answer; the journal forgets it unless ``keep`` is set."""
        results = list(results)
        # Notify before the journal forgets the demand. In the reverse order, a crash could lose
        # the refusal, because a refused demand has no commit.
        for ticket, result in results if not keep else ():
            if isinstance(result, Receipt) or ticket.state == "done":
                continue
            if str(result) != TAKEN_BACK:  # a client that took its demand back needs no notice
                text = result.text_with_codes() if isinstance(result, InvalidInput) else str(result)
                ticket.notify("refused", text)
        with self._changed:
            results = [(ticket, result) for ticket, result in results if ticket.state != "done"]
            if not keep:
                operations = [ticket.operation for ticket, _ in results]
                # Where no commit has the outcome, such as a refusal, the removal is fsynced. Else
                # a crash could bring a refused demand back, and it could then be booked.
                durably = any(
                    not isinstance(result, Receipt)
                    or result.outcome in ("unchanged", "waiting")
                    or ticket.has_released
                    for ticket, result in results
                )
                try:
                    self._journal.mark_done(operations, durably=durably)
                except errors.StateRepoError as error:  # the next write makes the removal durable
                    log.error(
                        "an answer cannot be journaled, so after a crash the demand may be carried "
                        "out again: %s",
                        error,
                    )
                    self._journal.mark_done(operations)
            for ticket, _ in results:
                _change(ticket, "done")
                # a proposed demand left the count of its requester already, and the end of a lease
                # was never in it
                if ticket.demand.operation != "expire" and ticket.proposal is None:
                    # it drops a requester at 0, so that passing vehicles leave nothing behind
                    self._of_requester -= Counter([ticket.requester])
        for ticket, result in results:
            if isinstance(result, Receipt):
                ticket.notify("pushed", f"pushed {result.commit}")
                ticket.future.set_result(result)
            else:
                ticket.future.set_exception(result)

    def fail(self, batch: Iterable[Ticket], error: DemandOpsError, keep: bool = False) -> None:
        self.answer([(ticket, error) for ticket in batch], keep)

    def end(self, error: errors.Unsound) -> None:
        self.close()
        with self._changed:
            left = [*self._journal.pending.values()]
        self.fail(left, error, keep=True)

    def _enqueue(self, ticket: Ticket) -> None:
        self._of_requester[ticket.requester] += 1
        self._queue.append(ticket)


def _change(ticket: Ticket, state: TicketState) -> bool:
    if state in _NEXT[ticket.state]:
        ticket.state = state
    return ticket.state == state
