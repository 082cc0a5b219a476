"""Demands under way, from submission to receipt, and their order."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

from demandops.base.errors import DemandOpsError, InvalidInput
from demandops.base.quoting import quoted
from demandops.cluster.health import Target
from demandops.decide.decision import Decision, Outcome
from demandops.model.demand.demand import Demand
from demandops.model.demand.goals import read_journaled
from demandops.model.ledger.ledger import ClaimChange
from demandops.repo.write.journal import JournalEntry, ProposalRecord

# ---- a demand under way, from its submission to its receipt ----

log = logging.getLogger("demandops")

# What a demand's listener is told.
Stage = Literal[
    "away",  # the state repo cannot be reached or written now
    "admitted",  # the demand is valid
    "booked",  # its claims are computed, but not committed yet
    "waiting",  # no node has room for it, so it will be booked later
    "committed",  # it has a commit
    "proposed",  # it awaits a person's approval
    "pushed",  # the commit in its receipt is published
    # Its answer is an error. Not told if the demand was not accepted, was taken back by its client,
    # or stays in the journal.
    "refused",
]
Listener = Callable[[Stage, str], None]

# Only demandops.serve.demand_lifecycle changes the state of a demand.
State = Literal["arrived", "queued", "committed", "proposed", "withdrawn", "done"]


@dataclass(frozen=True, slots=True)
class Receipt:
    # of a demand whose commit is published and durable; if an earlier attempt or run published it,
    # only the first four fields are known
    operation: str
    request_id: str
    outcome: Outcome
    commit: str  # of a demand that changed nothing, the newest one on which it was decided
    warnings: tuple[str, ...] = ()
    not_held: tuple[str, ...] = ()
    placed: tuple[str, ...] = ()  # which nodes the generator chose, and why
    lease_s: int | None = None
    targets: tuple[Target, ...] = ()  # the releases to follow, if the generator was asked for them
    changes: tuple[ClaimChange, ...] = ()


@dataclass(eq=False)
class Ticket:
    operation: str
    demand: Demand
    received: datetime
    listener: Listener = lambda stage, text: None
    future: Future[Receipt] = field(default_factory=Future)
    # True once a crash cannot lose the demand; false if it was refused without being journaled.
    journaled: Future[bool] = field(default_factory=Future)
    # A tip that does not include the demand; only later commits may record the demand.
    base: str = ""
    # Whether the remote may have accepted a push of the demand although no answer arrived.
    maybe_published: bool = False
    # Whether this demand released one that awaited approval: then it succeeds even if it ends no
    # claim.
    has_released: bool = False
    state: State = "queued"
    notified: set[str] = field(default_factory=set)
    proposal: ProposalRecord | None = None

    def __post_init__(self) -> None:
        for future in (self.future, self.journaled):
            future.set_running_or_notify_cancel()  # a demand is withdrawn, not canceled

    @property
    def requester(self) -> str:  # the first; empty if there is none
        return next(iter(self.demand.requesters()), "")

    def refuse(self, error: DemandOpsError) -> None:
        # only a demand that is not in the journal yet
        self.state = "done"
        self.future.set_exception(error)
        self.journaled.set_result(False)

    def notify(self, stage: Stage, text: str) -> None:
        # A stage is reported once, although a demand is evaluated again after each lost race. But a
        # proposal has another text once its pull request is known.
        key = text if stage == "proposed" else stage
        if key in self.notified:
            return
        self.notified.add(key)
        try:
            self.listener(stage, text)
        except Exception:
            log.exception("a listener failed")

    def mark_maybe_published(self, base: str) -> None:
        if not self.maybe_published:  # the oldest base counts, because any try may have succeeded
            self.base, self.maybe_published = base, True

    def journal_entry(self, proposal: ProposalRecord | None = None) -> JournalEntry:
        received = self.received.isoformat()
        return JournalEntry(self.operation, self.demand.goal, received, self.base, proposal)


def receipt_of(
    ticket: Ticket, decision: Decision, commit: str, targets: tuple[Target, ...]
) -> Receipt:
    return Receipt(
        operation=ticket.operation,
        request_id=decision.request.id,
        outcome=decision.outcome,
        commit=commit,
        warnings=decision.warnings,
        not_held=decision.changes.not_held,
        placed=decision.placed,
        lease_s=decision.lease_s,
        targets=targets,
        changes=decision.changes.claims,
    )


def reason_of(error: DemandOpsError) -> str:
    return error.text_with_codes() if isinstance(error, InvalidInput) else str(error)


def ticket_from_journal(entry: JournalEntry) -> Ticket:
    demand = read_journaled(entry.goal)
    ticket = Ticket(entry.operation, demand, datetime.fromisoformat(entry.received))
    name = f"demand {ticket.operation} ({quoted(demand.id)}) from the journal"

    def tell(stage: Stage, text: str) -> None:
        if stage in ("proposed", "pushed"):
            log.info("%s: %s", name, text)
        elif stage == "refused":
            log.error("%s: refused: %s", name, text)

    ticket.listener = tell
    ticket.journaled.set_result(True)
    ticket.mark_maybe_published(entry.base)  # the earlier run may have ended after the push
    if entry.proposal is not None:
        ticket.proposal = entry.proposal
        ticket.state = "withdrawn" if ticket.proposal.withdrawn else "proposed"
    return ticket


# ---- the queue of demands: requesters take turns, and related demands keep their order ----
#
# A demand counts only for its first requester. If another queued demand must stay ahead of the
# demand whose turn it is, the queue returns the other demand first.
#
# - Demands that share an application, a connection or a demand id keep their order.
# - A rollback or a decommission may touch any subject, so it overtakes no demand, and no demand
#   overtakes it.


@dataclass(eq=False)
class _Queued:
    number: int  # the order of arrival
    ticket: Ticket
    subjects: frozenset[Hashable] | None  # None: any
    # A removal only marks the demand, because a search in each deque would be slow; `_next_in`
    # drops those that have left.
    has_left: bool = False


class FairQueue:
    # Not thread-safe. With ``in_order``, demands leave in the order of their arrival, and
    # requesters take no turns.

    def __init__(self, *, in_order: bool = False) -> None:
        self._in_order = in_order
        self._queued: dict[Ticket, _Queued] = {}
        self._lanes: dict[str, deque[_Queued]] = {}
        self._subjects: dict[Hashable, deque[_Queued]] = {}
        self._barriers: deque[_Queued] = deque()
        self._arrived = 0

    def __len__(self) -> int:
        return len(self._queued)

    def append(self, ticket: Ticket) -> None:
        self._arrived += 1
        queued = _Queued(self._arrived, ticket, ticket.demand.touches())
        self._queued[ticket] = queued
        self._lanes.setdefault(self._lane(ticket), deque()).append(queued)
        for subject in queued.subjects or ():
            self._subjects.setdefault(subject, deque()).append(queued)
        if queued.subjects is None:
            self._barriers.append(queued)

    def put_back(self, tickets: Sequence[Ticket], served: Iterable[Ticket] = ()) -> None:
        # In the order in which they left, each before others of its requester. Their requesters get
        # the next turns. But a requester of ``served``, demands that left with them and do not come
        # back, had its turn and comes after all others.
        first = min((queued.number for queued in self._queued.values()), default=1) - len(tickets)
        again = {
            ticket: _Queued(number, ticket, ticket.demand.touches())
            for number, ticket in enumerate(tickets, start=first)
        }
        lanes = dict.fromkeys(map(self._lane, tickets))
        self._lanes = {name: self._lanes.pop(name, deque()) for name in lanes} | self._lanes
        for name in dict.fromkeys(map(self._lane, served)):
            if name in self._lanes:
                self._lanes[name] = self._lanes.pop(name)
        for queued in reversed(again.values()):
            self._lanes[self._lane(queued.ticket)].appendleft(queued)
            for subject in queued.subjects or ():
                self._subjects.setdefault(subject, deque()).appendleft(queued)
            if queued.subjects is None:
                self._barriers.appendleft(queued)
        self._queued = again | self._queued

    def remove(self, tickets: Collection[Ticket]) -> None:
        for ticket in tickets:
            if (queued := self._queued.pop(ticket, None)) is not None:
                queued.has_left = True

    def popleft(self) -> Ticket:
        while True:
            requester = next(iter(self._lanes))
            lane = self._lanes.pop(requester)
            if (first := _next_in(lane)) is not None:
                self._lanes[requester] = lane  # at the end, so that the other requesters come first
                break
        # whoever has the turn, related demands leave in the order in which they came
        while (predecessor := self._predecessor(first)) is not None:
            first = predecessor
        self.remove([first.ticket])
        for subject in first.subjects or ():  # many ids come only once; keep none of them
            if _next_in(self._subjects[subject]) is None:
                del self._subjects[subject]
        return first.ticket

    def _lane(self, ticket: Ticket) -> str:
        return "" if self._in_order else ticket.requester

    def _predecessor(self, queued: _Queued) -> _Queued | None:
        if (barrier := _next_in(self._barriers)) is not None and barrier.number < queued.number:
            return barrier
        if queued.subjects is None:
            oldest = next(iter(self._queued.values()))
            return oldest if oldest is not queued else None
        for subject in queued.subjects:
            if (first := _next_in(self._subjects[subject])) is not None and first is not queued:
                return first
        return None


def _next_in(lane: deque[_Queued]) -> _Queued | None:
    while lane and lane[0].has_left:
        lane.popleft()
    return lane[0] if lane else None
