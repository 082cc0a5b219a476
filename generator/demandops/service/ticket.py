"""A demand under way, from its submission to its receipt."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal

from demandops.cluster.health.release_health import Target
from demandops.decision import Decision, Outcome
from demandops.errors import DemandOpsError, InvalidInput
from demandops.ledger.claim_changes import ClaimChange
from demandops.quoting import quoted
from demandops.staterepo.write.journal import JournalEntry, ProposalRecord

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

# Only demandops.service.demand_lifecycle changes the state of a demand.
State = Literal["arrived", "queued", "committed", "proposed", "withdrawn", "done"]


@dataclass(frozen=True, slots=True)
class Receipt:
    """The outcome of a demand whose commit is published and durable.

    If an earlier attempt or run published the demand, only the first four fields are known.
    """

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
    goal: Any
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
    def name(self) -> str:
        """The id that the goal names, even if the goal is not valid; empty if it names none."""
        fields = self.goal if isinstance(self.goal, dict) else {}
        keys = ("id", "request", "demand", "name")
        return str(next((fields[key] for key in keys if fields.get(key)), ""))

    def refuse(self, error: DemandOpsError) -> None:
        """Answer a demand that is not in the journal yet with an error."""
        self.state = "done"
        self.future.set_exception(error)
        self.journaled.set_result(False)

    def notify(self, stage: Stage, text: str) -> None:
        """Report a stage to the listener once, or ``proposed`` once for each text."""
        # a demand is evaluated again after each lost race, which must not repeat its stages; a
        # proposal has another text once its pull request is known
        key = text if stage == "proposed" else stage
        if key in self.notified:
            return
        self.notified.add(key)
        try:
            self.listener(stage, text)
        except Exception:
            log.exception("a listener failed")

    def mark_maybe_published(self, base: str) -> None:
        """Record that a push on top of ``base`` may have succeeded although it seemed to fail."""
        if not self.maybe_published:  # the oldest base counts, because any try may have succeeded
            self.base, self.maybe_published = base, True

    def journal_entry(self, proposal: ProposalRecord | None = None) -> JournalEntry:
        received = self.received.isoformat()
        return JournalEntry(self.operation, self.goal, received, self.base, proposal)


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
    """Return a ticket whose listener logs what becomes of the demand."""
    ticket = Ticket(entry.operation, entry.goal, datetime.fromisoformat(entry.received))
    demand = f"demand {ticket.operation} ({quoted(ticket.name)}) from the journal"

    def tell(stage: Stage, text: str) -> None:
        if stage in ("proposed", "pushed"):
            log.info("%s: %s", demand, text)
        elif stage == "refused":
            log.error("%s: refused: %s", demand, text)

    ticket.listener = tell
    ticket.journaled.set_result(True)
    ticket.mark_maybe_published(entry.base)  # the earlier run may have ended after the push
    if entry.proposal is not None:
        ticket.proposal = entry.proposal
        ticket.state = "withdrawn" if ticket.proposal.withdrawn else "proposed"
    return ticket
