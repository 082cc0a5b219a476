"""The demands under way: their states, with a method for each change of state.

| state | the demand | next |
| --- | --- | --- |
| arrived | was submitted | queued, done |
| queued | is in the journal and may be evaluated | committed, proposed, withdrawn, done |
| committed | has a commit, and can no longer be withdrawn | committed, proposed, done |
| proposed | awaits a person's approval | proposed, queued, withdrawn, done |
| withdrawn | was taken back, released or replaced | done |
| done | is answered | |

A method that changes a state holds one lock while it writes to the journal, changes the state and
wakes the worker. So two threads cannot commit and withdraw a demand at the same time. Any thread
may submit or withdraw a demand. A thread of its own journals the demands that arrive, even while
the worker publishes other demands. Whoever takes or withdraws demands, or closes the queue, also
journals what has arrived. The worker's thread makes all other changes of state.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Collection, Iterable
from dataclasses import replace

from demandops.base import errors
from demandops.base.errors import DemandOpsError, QueueFull, ShuttingDown, StateRepoError, Unsound
from demandops.base.quoting import quoted
from demandops.base.runtime import Runtime
from demandops.repo.write.journal import Journal, ProposalRecord
from demandops.serve import queue
from demandops.serve.queue import Receipt, State, Ticket, ticket_from_journal

log = logging.getLogger("demandops")

TAKEN_BACK = "the demand was taken back before it was committed"

_NEXT: dict[State, tuple[State, ...]] = {
    "arrived": ("queued", "done"),
    "queued": ("committed", "proposed", "withdrawn", "done"),
    "committed": ("committed", "proposed", "done"),
    "proposed": ("proposed", "queued", "withdrawn", "done"),
    "withdrawn": ("done",),
    "done": (),
}


class Demands:
    def __init__(
        self, journal: Journal, limit: int, requester_limit: int | None, runtime: Runtime
    ) -> None:
        self._journal = journal
        # The limit of a requester does not count demands that await approval: a person takes days.
        self._limit, self._requester_limit = limit, requester_limit
        self._of_requester = Counter[str]()
        self._changed = runtime.condition()
        resumed = [ticket_from_journal(entry) for entry in journal.pending.values()]
        self._tickets = {ticket.operation: ticket for ticket in resumed}
        self._arrived = deque[Ticket]()
        self._arrival = runtime.event()
        self._new: list[Ticket] = []
        self._queue = queue.FairQueue(in_order=requester_limit is None)
        for ticket in resumed:
            if ticket.proposal is None:
                self._enqueue(ticket)
        self._taken_back: list[Ticket] = []
        self._closed = self._woken = False
        # Why no demand can be published now, or empty. QueueFull quotes it: a queue that is full
        # behind a remote that is away needs another remedy than a client that sends too much.
        self.blocked = ""

    # ---- queries ----

    @property
    def operations(self) -> tuple[str, ...]:
        with self._changed:
            return tuple(self._tickets)

    @property
    def proposed(self) -> list[Ticket]:
        """The demands of all proposals; a new one may not be on its branch yet."""
        with self._changed:
            return [ticket for ticket in self._tickets.values() if ticket.proposal is not None]

    @property
    def unpublished(self) -> int:
        """The number of demands still to publish: those in the journal that await no approval."""
        with self._changed:
            return sum(1 for entry in self._journal.pending.values() if entry.proposal is None)

    @property
    def has_queued(self) -> bool:
        return bool(self._arrived or self._queue)

    @property
    def must_not_wait(self) -> bool:
        return self.has_queued or self._closed

    # ---- waiting for demands ----

    def close(self) -> None:
        """Accept no further demands; the demands that have arrived are still carried out."""
        self._take_in()  # what came before is accepted
        with self._changed:
            self._closed = True
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
            self._wait(timeout, self.must_not_wait)
            return self.has_queued or not self._closed

    def new_demands(self, timeout: float) -> list[Ticket]:
        """Return the demands accepted since this or :meth:`take` was called; wait if none is."""
        with self._changed:
            self._wait(timeout, bool(self._new))
            # after a failed write the state of the journal is unknown, so the process must end
            self._journal.require_sound()
            new, self._new = self._new, []
            return new

    def _wait(self, timeout: float | None, has_work: bool) -> None:
        if not has_work and not self._woken:
            self._changed.wait(timeout)
        self._woken = False

    def take(self, batch: list[Ticket], limit: int) -> None:
        self._take_in()
        with self._changed:
            self._journal.require_sound()
            self._new.clear()
            room = min(limit - len(batch), len(self._queue))
            batch += [self._queue.popleft() for _ in range(room)]

    def put_back(self, batch: list[Ticket], served: Collection[Ticket]) -> None:
        # The next batch takes turns between these demands and those that others sent meanwhile. The
        # requesters of ``served``, the demands that were evaluated, come last.
        with self._changed:
            # `answer_withdrawn` answers the withdrawn ones
            left = [ticket for ticket in batch if ticket not in self._taken_back]
            self._queue.put_back(left, served)
            batch.clear()

    # ---- changes of state ----

    def arrive(self, ticket: Ticket) -> None:
        # No lock and no journal here: the caller answers ROS clients and must not wait for an
        # fsync. The thread of `journal_arrivals` takes the demand in.
        ticket.state = "arrived"
        self._arrived.append(ticket)
        self._arrival.set()
        if self._closed:  # that thread may have ended, so refuse the demand here
            self._take_in()

    def journal_arrivals(self) -> None:
        # demands that arrive during an fsync of the journal share the next fsync
        while not self._closed:
            self._arrival.wait()
            self._arrival.clear()
            self._take_in()

    def _take_in(self) -> None:
        if not self._arrived:
            return
        taken, refused = list[Ticket](), list[tuple[Ticket, DemandOpsError]]()
        with self._changed:
            for _ in range(len(self._arrived)):
                ticket = self._arrived.popleft()
                if (error := self._why_refused(ticket, len(taken))) is not None:
                    refused.append((ticket, error))
                    continue
                self._of_requester[ticket.requester] += 1
                self._tickets[ticket.operation] = ticket
                taken.append(ticket)
            try:
                self._journal.append(ticket.journal_entry() for ticket in taken)
            except Exception as failure:
                if isinstance(failure, DemandOpsError):
                    why = failure
                    log.error("%s", why)
                else:  # a bug must leave no demand without an answer
                    why = errors.internal(failure)
                    log.exception("internal error while journaling demands")
                self.wake()  # so that the worker ends the process if the journal is unsound
                for ticket in taken:
                    del self._tickets[ticket.operation]
                    self._of_requester[ticket.requester] -= 1
                    refused.append((ticket, why))
                taken = []
            for ticket in taken:
                _change(ticket, "queued")
                self._queue.append(ticket)
            self._new += taken
            self._changed.notify()
        for ticket in taken:
            ticket.journaled.set_result(True)
        for ticket, error in refused:
            ticket.refuse(error)

    def _why_refused(self, ticket: Ticket, others: int) -> DemandOpsError | None:
        if self._closed:
            return ShuttingDown("the generator is shutting down; send the demand again later")
        # the others were accepted just before, and are not queued yet
        if others + len(self._queue) >= self._limit:
            why = f" and cannot be published ({self.blocked})" if self.blocked else ""
            return QueueFull(
                f"{self._limit} demands are queued already{why}; send the demand again later"
            )
        if ticket.operation in self._tickets:
            message = "is the operation id of another demand; choose a new one"
            return errors.Refused([errors.fault("", f"'{ticket.operation}' {message}")])
        who = ticket.requester
        if (limit := self._requester_limit) is not None and self._of_requester[who] >= limit:
            whose = f"of {quoted(who)}" if who else "without a requester"
            return QueueFull(
                f"{limit} demands {whose} have no answer yet; send the demand again "
                "later, or raise the node's parameter requester_queue_limit"
            )
        return None

    def commit(self, ticket: Ticket) -> bool:
        with self._changed:
            return _change(ticket, "committed")

    def propose(self, ticket: Ticket, record: ProposalRecord) -> bool:
        """Journal the proposal of a demand; false if it is withdrawn or answered already."""
        with self._changed:
            if not _may_become(ticket, "proposed"):
                return False
            self._journal.append([ticket.journal_entry(record)])
            self._leave(ticket)
            ticket.proposal = record
            return _change(ticket, "proposed")

    def requeue(self, tickets: Iterable[Ticket]) -> None:
        with self._changed:
            for ticket in tickets:
                ticket.mark_maybe_published(ticket.base)  # a person may have merged it meanwhile
                self._journal.append([ticket.journal_entry()])
                ticket.proposal = None
                _change(ticket, "queued")
                self._enqueue(ticket)
            self._changed.notify()

    def withdraw(self, operation: str) -> bool:
        self._take_in()
        with self._changed:
            ticket = self._tickets.get(operation)
            if ticket is None or not _may_become(ticket, "withdrawn"):
                return ticket is not None and ticket.state == "withdrawn"
            try:
                self._withdraw(ticket, TAKEN_BACK)
            except (StateRepoError, Unsound) as error:  # if unsound, the worker ends the process
                log.error("demand %s cannot be withdrawn: %s", operation, error)
                self.wake()
                return False
        return True

    def withdraw_proposed(self, tickets: Iterable[Ticket], reason: str) -> None:
        with self._changed:
            for ticket in tickets:
                if ticket.state == "proposed":
                    self._withdraw(ticket, reason)

    def _withdraw(self, ticket: Ticket, reason: str) -> None:
        if ticket.proposal is None:
            # a restart must not resume the withdrawn demand
            self._journal.mark_done([ticket.operation], durably=True)
            self._taken_back.append(ticket)
        else:  # the demand stays in the journal until its branch is deleted
            record = replace(ticket.proposal, withdrawn=reason)
            self._journal.append([ticket.journal_entry(record)])
            ticket.proposal = record
        _change(ticket, "withdrawn")
        self.wake()  # the worker answers the demand even while nothing can be published

    def answer_withdrawn(self, batch: list[Ticket]) -> None:
        # those that were withdrawn while proposed are answered after their branch is deleted
        with self._changed:
            withdrawn, self._taken_back = self._taken_back, []
            if not withdrawn:
                return
            self._queue.remove(withdrawn)
            batch[:] = [ticket for ticket in batch if ticket not in withdrawn]
        self.fail(withdrawn, errors.Withdrawn(TAKEN_BACK))

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
                ticket.notify("refused", queue.reason_of(result))
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
                except StateRepoError as error:  # the next write makes the removal durable
                    log.error(
                        "an answer cannot be journaled, so after a crash the demand may be carried "
                        "out again: %s",
                        error,
                    )
                    self._journal.mark_done(operations)
            for ticket, _ in results:
                _change(ticket, "done")
                if self._tickets.pop(ticket.operation, None):
                    self._leave(ticket)
        for ticket, result in results:
            if isinstance(result, Receipt):
                ticket.notify("pushed", f"pushed {result.commit}")
                ticket.future.set_result(result)
            else:
                ticket.future.set_exception(result)

    def fail(self, batch: Iterable[Ticket], error: DemandOpsError, keep: bool = False) -> None:
        self.answer([(ticket, error) for ticket in batch], keep)

    def end(self, error: Unsound) -> None:
        self.close()
        with self._changed:
            left = list(self._tickets.values())
        self.fail(left, error, keep=True)

    def _enqueue(self, ticket: Ticket) -> None:
        self._of_requester[ticket.requester] += 1
        self._queue.append(ticket)

    def _leave(self, ticket: Ticket) -> None:
        # a proposed demand left the count of its requester already
        if ticket.proposal is None:
            # this difference drops a requester at 0, so that passing vehicles leave nothing behind
            self._of_requester -= Counter([ticket.requester])


def _may_become(ticket: Ticket, state: State) -> bool:
    return state in _NEXT[ticket.state]


def _change(ticket: Ticket, state: State) -> bool:
    if _may_become(ticket, state):
        ticket.state = state
    return ticket.state == state
