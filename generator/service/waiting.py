"""The demands that wait to be settled: handed in from any thread, taken up by one.

Every state of a ticket changes under one lock, so a demand is taken back before it is committed or
not at all. What is taken up is in the outbox before anything is done with it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from contextlib import suppress

from generator.errors import DemandOpsError, QueueFull, ShuttingDown, Withdrawn
from generator.service.ticket import Receipt, Ticket, left_over
from generator.staterepo.outbox import Outbox

TAKEN_BACK = "the demand was taken back before it was committed"


class Waiting:
    """A bounded queue over an outbox.

    ``blocked`` says why nothing gets on, for whoever finds the queue full; empty where it does.
    """

    def __init__(self, outbox: Outbox, limit: int) -> None:
        self._outbox = outbox
        self._limit = limit
        self._changed = threading.Condition()
        self._queue = deque(left_over(entry) for entry in outbox.pending.values())
        self._tickets = {ticket.operation: ticket for ticket in self._queue}
        self._unkept: list[Ticket] = []
        self._closed = self._woken = False
        self.blocked = ""

    @property
    def operations(self) -> tuple[str, ...]:
        """The demands that have no answer yet."""
        with self._changed:
            return tuple(self._tickets)

    @property
    def anything(self) -> bool:
        """Whether a demand waits to be taken up."""
        return bool(self._queue)

    @property
    def unpublished(self) -> int:
        """How many demands the outbox holds."""
        return len(self._outbox.pending)

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
            self._unkept.append(ticket)
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
    def urgent(self) -> bool:
        """Whether something is to do that must not wait for a look at the remote."""
        return bool(self._queue) or self._closed

    def keep(self, timeout: float) -> list[Ticket]:
        """Wait for demands that come in and journal them, for nothing gets on at the moment.

        Returns:
            Those that came; none where ``timeout`` seconds passed, one was taken back, or it was
            woken.
        """
        with self._changed:
            if not self._unkept and not self._woken:
                self._changed.wait(timeout)
            self._woken = False
            return self._journal()

    def _journal(self) -> list[Ticket]:
        """Put what came in since the last time into the outbox."""
        fresh = [
            ticket
            for ticket in self._unkept
            if ticket.state == "waiting" and ticket.operation not in self._outbox.pending
        ]
        self._outbox.append(ticket.entry() for ticket in fresh)
        self._unkept = []
        return fresh

    def take_up(self, batch: list[Ticket], limit: int) -> None:
        """Move what waits into the batch, up to ``limit`` in all; all that waits is journaled."""
        with self._changed:  # held while journaling: a demand is taken back before it or after
            room = limit - len(batch)
            fresh = [self._queue.popleft() for _ in range(min(room, len(self._queue)))]
            batch += fresh
            self._journal()

    def withdraw(self, operation: str) -> bool:
        """Take a demand back. False once it is committed, or was never known."""
        with self._changed:
            ticket = self._tickets.get(operation)
            if ticket is None or ticket.state != "waiting":
                return ticket is not None and ticket.state == "withdrawn"
            ticket.state = "withdrawn"
            self._outbox.done([operation], durably=True)  # nor may a restart take it up
            self._woken = True
            self._changed.notify()  # it is answered although nothing gets on
        return True

    def hold(self, ticket: Ticket) -> bool:
        """Make a demand one that cannot be taken back any more; false where it was."""
        with self._changed:
            if ticket.state != "withdrawn":
                ticket.state = "committed"
            return ticket.state == "committed"

    def dismiss_withdrawn(self, batch: list[Ticket]) -> None:
        """Answer those that were taken back at once: the remote may be away for long."""
        with self._changed:
            gone = [ticket for ticket in self._queue if ticket.state == "withdrawn"]
            if gone:
                self._queue = deque(one for one in self._queue if one.state != "withdrawn")
        withdrawn = [ticket for ticket in batch if ticket.state == "withdrawn"]
        batch[:] = [ticket for ticket in batch if ticket.state != "withdrawn"]
        for ticket in [*withdrawn, *gone]:
            self._forget(ticket)
            ticket.future.set_exception(Withdrawn(TAKEN_BACK))

    def answer(self, results: Iterable[tuple[Ticket, Receipt | DemandOpsError]]) -> None:
        """Tell each what came of it; the outbox forgets them."""
        results = list(results)
        with self._changed:
            self._outbox.done(ticket.operation for ticket, _ in results)
        for ticket, result in results:
            self._forget(ticket)
            if isinstance(result, Receipt):
                ticket.tell("pushed", f"pushed {result.commit}")
                ticket.future.set_result(result)
            else:
                ticket.future.set_exception(result)

    def fail(self, batch: Iterable[Ticket], error: DemandOpsError, keep: bool = False) -> None:
        """Answer every demand of a batch with an error; ``keep`` leaves them in the outbox."""
        batch = list(batch)
        if not keep:
            with self._changed, suppress(OSError):  # a full disk must not withhold the answer
                self._outbox.done(ticket.operation for ticket in batch)
        for ticket in batch:
            self._forget(ticket)
            ticket.future.set_exception(error)

    def _forget(self, ticket: Ticket) -> None:
        with self._changed:
            ticket.state = "done"
            self._tickets.pop(ticket.operation, None)
