"""The demands that wait to be settled: handed in from any thread, taken up by one.

Every state of a ticket changes under one lock, so a demand is taken back before it is committed or
not at all. What is taken up is in the outbox before anything is done with it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

from demandops.errors import DemandOpsError, QueueFull, ShuttingDown, Withdrawn
from demandops.service.ticket import ProposalRecord, Receipt, Ticket, ticket_from_journal
from demandops.staterepo.write.journal import Journal

TAKEN_BACK = "the demand was taken back before it was committed"


class DemandQueue:
    """A bounded queue over an outbox.

    ``blocked`` says why nothing gets on, for whoever finds the queue full; empty where it does.
    """

    def __init__(self, outbox: Journal, limit: int) -> None:
        self._journal = outbox
        self._limit = limit
        self._changed = threading.Condition()
        self._queue = deque(ticket_from_journal(entry) for entry in outbox.pending.values())
        self._tickets = {ticket.operation: ticket for ticket in self._queue}
        self._not_journaled: list[Ticket] = []
        self._closed = self._woken = False
        self.blocked = ""

    @property
    def operations(self) -> tuple[str, ...]:
        """The demands that have no answer yet."""
        with self._changed:
            return tuple(self._tickets)

    @property
    def has_waiting(self) -> bool:
        """Whether a demand waits to be taken up."""
        return bool(self._queue)

    @property
    def unpublished(self) -> int:
        """How many demands the outbox holds, but for those that await approval."""
        return sum(1 for entry in self._journal.pending.values() if entry.proposal is None)

    def add(self, ticket: Ticket) -> None:
        """Put a demand in.

        Raises:
            ShuttingDown, QueueFull: where it is not taken.
        """
        with self._changed:
            if self._closed:
                raise ShuttingDown("the generator is shutting down; send the demand again later")
            if len(self._queue) >= self._limit:
                why = f" for the state repo: {self.blocked}" if self.blocked else ""
                raise QueueFull(
                    f"{self._limit} demands are waiting already{why}; send it again later"
                )
            self._queue.append(ticket)
            self._not_journaled.append(ticket)
            self._tickets[ticket.operation] = ticket
            self._changed.notify()

    def close(self) -> None:
        """Take no more."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def wait(self, timeout: float | None) -> bool:
        """Wait until something is there or ``timeout`` has passed; false once all is settled."""
        with self._changed:
            if not self._queue and not self._closed and not self._woken:
                self._changed.wait(timeout)
            self._woken = False
            return bool(self._queue) or not self._closed

    def wake(self) -> None:
        """End a wait although nothing came; from any thread."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    @property
    def must_not_wait(self) -> bool:
        """Whether something is to do that must not wait for a look at the remote."""
        return bool(self._queue) or self._closed

    def journal_arrivals(self, timeout: float) -> list[Ticket]:
        """Wait for demands that come in and journal them, for nothing gets on at the moment.

        Returns:
            Those that came; none where ``timeout`` seconds passed, one was taken back, or it was
            woken.
        """
        with self._changed:
            if not self._not_journaled and not self._woken:
                self._changed.wait(timeout)
            self._woken = False
            return self._journal_new()

    def _journal_new(self) -> list[Ticket]:
        """Put what came in since the last time into the outbox."""
        fresh = [
            ticket
            for ticket in self._not_journaled
            if ticket.state == "waiting" and ticket.operation not in self._journal.pending
        ]
        self._journal.append(ticket.journal_entry() for ticket in fresh)
        self._not_journaled = []
        return fresh

    def set_proposal(self, ticket: Ticket, record: ProposalRecord) -> bool:
        """Keep on the disk what a demand awaits approval on; false where it was taken back.

        Until it is booked, a demand that awaits approval can be taken back.
        """
        with self._changed:
            if ticket.state == "withdrawn":
                return False
            ticket.state, ticket.proposal = "waiting", record
            self._journal.append([ticket.journal_entry()])
        return True

    def requeue(self, tickets: Iterable[Ticket]) -> None:
        """Put demands in again that need no approval any more."""
        with self._changed:
            for ticket in tickets:
                ticket.proposal = None
                self._journal.append([ticket.journal_entry()])
                self._queue.append(ticket)
            self._changed.notify()

    def take(self, batch: list[Ticket], limit: int) -> None:
        """Move what waits into the batch, up to ``limit`` in all; all that waits is journaled."""
        with self._changed:  # held while journaling: a demand is taken back before it or after
            room = limit - len(batch)
            fresh = [self._queue.popleft() for _ in range(min(room, len(self._queue)))]
            batch += fresh
            self._journal_new()

    def withdraw(self, operation: str) -> bool:
        """Take a demand back. False once it is committed, or was never known."""
        with self._changed:
            ticket = self._tickets.get(operation)
            if ticket is None or ticket.state != "waiting":
                return ticket is not None and ticket.state == "withdrawn"
            if ticket.proposal is not None:
                self._withdraw_proposed(ticket, TAKEN_BACK)
                return True
            ticket.state = "withdrawn"
            self._journal.done([operation], durably=True)  # nor may a restart take it up
            self._woken = True
            self._changed.notify()  # it is answered although nothing gets on
        return True

    def withdraw_proposed(self, tickets: Iterable[Ticket], reason: str) -> None:
        """Mark demands that await approval as ones to go; a restart knows it as well."""
        with self._changed:
            for ticket in tickets:
                self._withdraw_proposed(ticket, reason)

    def _withdraw_proposed(self, ticket: Ticket, reason: str) -> None:
        """Kept in the outbox until the branch is gone: nobody may merge what was taken back."""
        if ticket.proposal is None or ticket.state != "waiting":
            return
        ticket.state = "withdrawn"
        ticket.proposal = replace(ticket.proposal, withdrawn=reason)
        self._journal.append([ticket.journal_entry()])
        self._woken = True
        self._changed.notify()

    def mark_committed(self, ticket: Ticket) -> bool:
        """Make a demand one that cannot be taken back any more; false where it was."""
        with self._changed:
            if ticket.state != "withdrawn":
                ticket.state = "committed"
            return ticket.state == "committed"

    def answer_withdrawn(self, batch: list[Ticket]) -> None:
        """Answer those that were taken back at once: the remote may be away for long.

        Not one that was proposed: its branch has to go first.
        """
        with self._changed:
            gone = [ticket for ticket in self._queue if _is_withdrawn(ticket)]
            if gone:
                self._queue = deque(one for one in self._queue if not _is_withdrawn(one))
        withdrawn = [ticket for ticket in batch if _is_withdrawn(ticket)]
        batch[:] = [ticket for ticket in batch if not _is_withdrawn(ticket)]
        for ticket in [*withdrawn, *gone]:
            self._forget(ticket)
            ticket.future.set_exception(Withdrawn(TAKEN_BACK))

    def answer(self, results: Iterable[tuple[Ticket, Receipt | DemandOpsError]]) -> None:
        """Tell each what came of it; the outbox forgets them."""
        results = list(results)
        with self._changed:
            self._journal.done(ticket.operation for ticket, _ in results)
        for ticket, result in results:
            self._forget(ticket)
            if isinstance(result, Receipt):
                ticket.notify("pushed", f"pushed {result.commit}")
                ticket.future.set_result(result)
            else:
                ticket.future.set_exception(result)

    def fail(self, batch: Iterable[Ticket], error: DemandOpsError, keep: bool = False) -> None:
        """Answer every demand of a batch with an error; ``keep`` leaves them in the outbox."""
        batch = list(batch)
        if not keep:
            with self._changed, suppress(OSError):  # a full disk must not withhold the answer
                self._journal.done(ticket.operation for ticket in batch)
        for ticket in batch:
            self._forget(ticket)
            ticket.future.set_exception(error)

    def _forget(self, ticket: Ticket) -> None:
        with self._changed:
            ticket.state = "done"
            self._tickets.pop(ticket.operation, None)


def _is_withdrawn(ticket: Ticket) -> bool:
    return ticket.state == "withdrawn" and ticket.proposal is None
