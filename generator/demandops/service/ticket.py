"""A demand under way, from the hand-in to its receipt."""

from __future__ import annotations

import json
import logging
import re
import uuid
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from typing import Any, Literal

from demandops.cluster.health import Target
from demandops.decision import Outcome
from demandops.errors import Refused, fault
from demandops.ledger.apply import ClaimChange
from demandops.staterepo.write.journal import JournalEntry

log = logging.getLogger("demandops")

Stage = Literal["away", "admitted", "booked", "committed", "proposed", "pushed"]
"""``away``: the state repo cannot be reached or takes nothing for now; the text says why."""
Listener = Callable[[Stage, str], None]

_OPERATION = re.compile(r"[A-Za-z0-9_.-]{1,100}")


@dataclass(frozen=True, slots=True)
class Receipt:
    """What came of a demand: the commit that holds it is published and durable.

    ``commit`` is the tip where the demand changed nothing. ``lease_s`` is for how many seconds
    it holds unless it is renewed, nothing where it has no end. ``targets`` are the releases that
    it needs or gave up, where the generator was asked to say so. ``changes`` are the claims that it
    changed; none where that was published before and nobody could be told.
    """

    operation: str
    request_id: str
    outcome: Outcome
    commit: str
    warnings: tuple[str, ...] = ()
    not_held: tuple[str, ...] = ()
    lease_s: int | None = None
    targets: tuple[Target, ...] = ()
    changes: tuple[ClaimChange, ...] = ()


@dataclass(frozen=True, slots=True)
class ProposalRecord:
    """What the journal keeps of a proposal: enough to take it up again.

    ``commits`` are those that the branch was put to or is about to be, the newest last, and
    ``base`` the main below the newest. ``pushed`` tells that the branch was there once, ``link``
    where the server says that a person finds it, ``withdrawn`` why it is to go, where it is.
    """

    branch: str
    commits: tuple[str, ...] = ()
    base: str = ""
    pushed: bool = False
    link: str = ""
    withdrawn: str = ""


@dataclass(eq=False)
class Ticket:
    """A demand under way. ``future`` gives its receipt, or raises why there is none.

    ``base`` is the tip that was known when it came in, ``maybe_published`` whether a push that
    held it may have been taken although nobody heard so.
    """

    operation: str
    goal: Any
    received: datetime
    listener: Listener
    future: Future[Receipt] = field(default_factory=Future)
    base: str = ""
    maybe_published: bool = False
    state: Literal["waiting", "committed", "withdrawn", "done"] = "waiting"
    notified: set[str] = field(default_factory=set)
    proposal: ProposalRecord | None = None

    def __post_init__(self) -> None:
        self.future.set_running_or_notify_cancel()  # `withdraw` takes a demand back, not cancel

    def notify(self, stage: Stage, text: str) -> None:
        """Tell a stage once, also where the demand is judged again; of a proposal each news."""
        news = text if stage == "proposed" else stage
        if news in self.notified:
            return
        self.notified.add(news)
        try:
            self.listener(stage, text)
        except Exception:
            log.exception("a listener failed")

    def mark_maybe_published(self, base: str) -> None:
        """Note that a push on top of ``base`` may have been taken although it seemed to fail."""
        if not self.maybe_published:
            self.base, self.maybe_published = base, True

    def journal_entry(self) -> JournalEntry:
        """Return what the outbox keeps of it."""
        kept = asdict(self.proposal) if self.proposal else None
        return JournalEntry(self.operation, self.goal, self.received.isoformat(), self.base, kept)


def new_ticket(goal: object, operation: str | None, listener: Listener) -> Ticket:
    """Return a ticket for a goal; its future has failed already where the goal is no plain data.

    Raises:
        ValueError: for an operation id that a trailer could not carry.
    """
    operation = operation or str(uuid.uuid4())
    if not _OPERATION.fullmatch(operation):
        raise ValueError(f"{operation!r} is no operation id; use letters, digits and dashes")
    ticket = Ticket(operation, goal, datetime.now(timezone.utc), listener)
    try:
        ticket.goal = json.loads(json.dumps(goal))
    except (TypeError, ValueError, RecursionError):
        ticket.future.set_exception(Refused([fault("", "the goal is no plain data")]))
    return ticket


def ticket_from_journal(entry: JournalEntry) -> Ticket:
    """Return a ticket for a demand that an earlier run left in the outbox."""
    received = datetime.fromisoformat(entry.received)
    ticket = Ticket(entry.operation, entry.goal, received, lambda stage, text: None)
    ticket.mark_maybe_published(entry.base)
    if entry.proposal is not None:
        kept = entry.proposal
        ticket.proposal = ProposalRecord(**{**kept, "commits": tuple(kept["commits"])})
    return ticket
