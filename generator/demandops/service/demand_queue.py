"""The queue of demands: any thread adds, the worker thread takes.

A ticket's state changes under one lock, so a demand is withdrawn before it is committed or not at
all. A demand is in the journal before the worker evaluates it.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable
from dataclasses import replace

from demandops.errors import DemandOpsError, QueueFull, ShuttingDown, StateRepoError, Withdrawn
from demandops.runtime import Runtime
from demandops.service.ticket import ProposalRecord, Receipt, Ticket, ticket_from_journal
from demandops.staterepo.write.journal import Journal

log = logging.getLogger("demandops")

TAKEN_BACK = "the demand was taken back before it was committed"


class DemandQueue:
    """A bounded queue with a journal.

    ``blocked`` is why no demand can be published now, or empty; it is part of the error when the
    queue is full.
    """

    def __init__(self, journal: Journal, limit: int, runtime: Runtime) -> None:
        self._journal = journal
        self._limit = limit
        self._changed = runtime.condition()
        self._queue = deque(ticket_from_journal(entry) for entry in journal.pending.values())
        self._tickets = {ticket.operation: ticket for ticket in self._queue}
        self._not_journaled: list[Ticket] = []
        self._closed = self._woken = False
        self.blocked = ""

    @property
    def operations(self) -> tuple[str, ...]:
        """The operation ids of the demands that have no answer yet."""
        with self._changed:
            return tuple(self._tickets)

    @property
    def has_waiting(self) -> bool:
        """Whether a demand waits to be taken."""
        return bool(self._queue)

    @property
    def unpublished(self) -> int:
        """How many demands are in the journal and do not await approval."""
        with self._changed:
            return sum(1 for entry in self._journal.pending.values() if entry.proposal is None)

    def add(self, ticket: Ticket) -> None:
        """Add a demand.

        Raises:
            ShuttingDown, QueueFull: if the queue is closed or full.
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
        """Accept no more demands."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def wait(self, timeout: float | None) -> bool:
        """Wait for a demand, :meth:`wake` or ``timeout``; return False once closed and empty."""
        with self._changed:
            if not self._queue and not self._closed and not self._woken:
                self._changed.wait(timeout)
            self._woken = False
            return bool(self._queue) or not self._closed

    def wake(self) -> None:
        """End a wait although no demand came; from any thread."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    @property
    def must_not_wait(self) -> bool:
        """Whether there is something to do that must not wait for a fetch."""
        return bool(self._queue) or self._closed

    def journal_arrivals(self, timeout: float) -> list[Ticket]:
        """Wait for new demands and journal them, while nothing can be published.

        Returns:
            The new demands; none after ``timeout`` seconds, a withdrawal or :meth:`wake`.
        """
        with self._changed:
            if not self._not_journaled and not self._woken:
                self._changed.wait(timeout)
            self._woken = False
            return self._journal_new([])

    def _journal_new(self, batch: list[Ticket]) -> list[Ticket]:
        """Journal what is not in the journal; if that fails, answer it with the error."""
        new = [
            ticket
            for ticket in self._not_journaled
            if ticket.state == "waiting" and ticket.operation not in self._journal.pending
        ]
        self._not_journaled = []
        try:
            self._journal.append(ticket.journal_entry() for ticket in new)
        except StateRepoError as error:
            log.error("%s", error)
            refused = set(new)
            self._queue = deque(ticket for ticket in self._queue if ticket not in refused)
            batch[:] = [ticket for ticket in batch if ticket not in refused]
            self.fail(new, error, keep=True)
            return []
        return new

    def set_proposal(self, ticket: Ticket, record: ProposalRecord) -> bool:
        """Journal the proposal that a demand waits for; return False if it was withdrawn.

        A demand that awaits approval can still be withdrawn.
        """
        with self._changed:
            if not ticket.can_become("proposed"):
                return False
            self._journal.append([ticket.journal_entry(record)])
            ticket.proposal = record
            return ticket.become("proposed")

    def requeue(self, tickets: Iterable[Ticket]) -> None:
        """Queue demands again that no longer need approval."""
        with self._changed:
            for ticket in tickets:
                self._journal.append([ticket.journal_entry()])
                ticket.proposal = None
                ticket.become("waiting")
                self._queue.append(ticket)
            self._changed.notify()

    def take(self, batch: list[Ticket], limit: int) -> None:
        """Move demands into ``batch``, up to ``limit`` in all, and journal all that wait."""
        with self._changed:  # keep the lock while journaling, so that none is withdrawn in between
            room = limit - len(batch)
            batch += [self._queue.popleft() for _ in range(min(room, len(self._queue)))]
            self._journal_new(batch)

    def withdraw(self, operation: str) -> bool:
        """Withdraw a demand; return False if it is too late or impossible."""
        with self._changed:
            ticket = self._tickets.get(operation)
            if ticket is None or not ticket.can_become("withdrawn"):
                return ticket is not None and ticket.state == "withdrawn"
            try:
                if ticket.state == "proposed":
                    self._withdraw_proposed(ticket, TAKEN_BACK)
                    return True
                self._journal.mark_done([operation], durably=True)  # a restart must not resume it
            except StateRepoError as error:
                log.error("demand %s cannot be withdrawn: %s", operation, error)
                return False
            ticket.become("withdrawn")
            self._woken = True
            self._changed.notify()  # the worker answers it even while nothing can be published
        return True

    def withdraw_proposed(self, tickets: Iterable[Ticket], reason: str) -> None:
        """Withdraw demands that await approval; a restart knows it as well."""
        with self._changed:
            for ticket in tickets:
                self._withdraw_proposed(ticket, reason)

    def _withdraw_proposed(self, ticket: Ticket, reason: str) -> None:
        """Keep the demand in the journal until its branch is deleted, so that none merges it."""
        if ticket.proposal is None or ticket.state != "proposed":
            return
        record = replace(ticket.proposal, withdrawn=reason)
        self._journal.append([ticket.journal_entry(record)])
        ticket.proposal = record
        ticket.become("withdrawn")
        self._woken = True
        self._changed.notify()

    def mark_committed(self, ticket: Ticket) -> bool:
        """Refuse further withdrawals of a demand; return False if it was withdrawn before."""
        with self._changed:
            return ticket.become("committed")

    def answer_withdrawn(self, batch: list[Ticket]) -> None:
        """Answer withdrawn demands at once, because the remote may be unreachable for long.

        A withdrawn proposal is answered later: its branch is deleted first.
        """
        with self._changed:
            withdrawn = [ticket for ticket in [*batch, *self._queue] if _is_withdrawn(ticket)]
            if not withdrawn:
                return
            self._queue = deque(t for t in self._queue if not _is_withdrawn(t))
            batch[:] = [ticket for ticket in batch if not _is_withdrawn(ticket)]
        self.fail(withdrawn, Withdrawn(TAKEN_BACK))

    def answer(
        self, results: Iterable[tuple[Ticket, Receipt | DemandOpsError]], keep: bool = False
    ) -> None:
        """Answer each demand with its result and remove it from the journal, unless ``keep``.

        A demand is answered once: a later result is dropped.
        """
        with self._changed:
            results = [(ticket, result) for ticket, result in results if ticket.can_become("done")]
            if not keep:
                self._journal.mark_done(ticket.operation for ticket, _ in results)
            for ticket, _ in results:
                ticket.become("done")
                self._tickets.pop(ticket.operation, None)
        for ticket, result in results:
            if isinstance(result, Receipt):
                ticket.notify("pushed", f"pushed {result.commit}")
                ticket.future.set_result(result)
            else:
                ticket.future.set_exception(result)

    def fail(self, batch: Iterable[Ticket], error: DemandOpsError, keep: bool = False) -> None:
        """Answer every demand of a batch with an error."""
        self.answer([(ticket, error) for ticket in batch], keep)


def _is_withdrawn(ticket: Ticket) -> bool:
    return ticket.state == "withdrawn" and ticket.proposal is None
