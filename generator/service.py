"""The one use case: submit a demand, get a receipt when it is published.

One worker thread owns the state repo. Demands that arrive together are committed one by one and
published once; a lone one at once. Everything received is in the outbox first, so a crash loses
nothing, and when the remote has moved the demands themselves are judged again on the new tip.
"""

from __future__ import annotations

import json
import logging
import random
import re
import threading
import uuid
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal, TypeAlias

from generator import settings
from generator.catalog.catalog import Catalog
from generator.decision import Decision, Outcome, decide
from generator.errors import (
    DemandOpsError,
    InvalidInput,
    QueueFull,
    Refused,
    ShuttingDown,
    StateRepoError,
    Withdrawn,
    fault,
)
from generator.staterepo import history, remote, writer
from generator.staterepo import snapshot as snapshots
from generator.staterepo.outbox import Entry, Slot
from generator.staterepo.remote import PushDenied, RemoteAway
from generator.staterepo.snapshot import Progress, Snapshot

log = logging.getLogger("demandops")

Stage = Literal["admitted", "booked", "committed", "pushed"]
Listener = Callable[[Stage, str], None]

_FIRST_PAUSE_S = 0.05
_LONGEST_PAUSE_S = 10.0
_STOP_TIMEOUT_S = 20.0
_BATCH_LIMIT_EMBEDDED = 20
_BATCH_LIMIT_REMOTE = 200
"""Demands that are published together: a push costs some 50 ms, moving a branch less than one."""
_TIDY_EVERY = 300
_OPERATION = re.compile(r"[A-Za-z0-9_.-]{1,100}")
_TAKEN_BACK = "the demand was taken back before it was committed"


@dataclass(frozen=True, slots=True)
class Receipt:
    """What came of a demand: the commit that holds it is published and durable.

    ``commit`` is the tip where the demand changed nothing.
    """

    operation: str
    request_id: str
    outcome: Outcome
    commit: str
    warnings: tuple[str, ...] = ()
    not_held: tuple[str, ...] = ()


@dataclass(eq=False)
class Ticket:
    """A demand under way. ``future`` gives its receipt, or raises why there is none."""

    operation: str
    goal: Any
    received: datetime
    listener: Listener
    future: Future[Receipt] = field(default_factory=Future)
    base: str = ""
    maybe_published: bool = False
    state: Literal["waiting", "committed", "withdrawn", "done"] = "waiting"
    told: set[str] = field(default_factory=set)


_Result: TypeAlias = tuple[Ticket, Receipt | DemandOpsError]


class Generator:
    """Takes demands from any thread and turns them into commits of one state repo."""

    def __init__(
        self,
        state_repo: str,
        *,
        data: Path | None = None,
        queue_limit: int = settings.QUEUE_LIMIT,
        progress: Progress = lambda done, total: None,
        on_published: Callable[[Catalog], None] = lambda catalog: None,
    ) -> None:
        """Open the state repo and start the worker; what an earlier run left over comes first.

        Args:
            state_repo: a folder with a bare repository, or a URL that git clones.
            data: where outbox and clone are kept; by default :func:`settings.data_home`.
            queue_limit: how many demands may wait.
            progress: told (files read, files in all) while the ledger is loaded.
            on_published: called in the worker thread after every push, with the catalog in force;
                must return at once.

        Raises:
            StateRepoError, InvalidInput: where the state repo cannot be used.
        """
        self._slot = Slot(data or settings.data_home(state_repo))
        try:
            self._repository = remote.connect(state_repo, self._slot.folder, log.info)
            self._snapshot = writer.first_snapshot(self._repository, progress)
        except BaseException:
            self._slot.close()
            raise
        self.given_address = state_repo
        self.queue_limit = queue_limit
        self._on_published = on_published
        self._since_tidy = 0
        embedded = self._repository.always_current
        self._batch_limit = _BATCH_LIMIT_EMBEDDED if embedded else _BATCH_LIMIT_REMOTE
        self._queue: deque[Ticket] = deque()
        self._changed = threading.Condition()
        self._tickets: dict[str, Ticket] = {}
        self._stopping = False
        self._finished: Future[bool] | None = None
        self._giving_up = threading.Event()
        for entry in self._slot.outbox.pending.values():
            log.info("taking up demand %s from the outbox", entry.operation)
            self._enqueue(_ticket_of(entry))
        self._worker = threading.Thread(target=self._run, name="demandops-writer", daemon=True)
        self._worker.start()

    @property
    def address(self) -> str:
        """The state repo, without secrets."""
        return self._repository.address

    @property
    def snapshot(self) -> Snapshot:
        """The newest published state; safe to read from any thread."""
        return self._snapshot

    def submit(
        self,
        goal: object,
        operation: str | None = None,
        listener: Listener = lambda stage, text: None,
    ) -> Ticket:
        """Hand in a demand; returns at once.

        Args:
            goal: the reference's action goal as plain data (:mod:`generator.demand.wire`).
            operation: a unique id for this hand-in; one is made where it is left out.
            listener: told each stage, from the worker thread.

        Returns:
            A ticket whose future gives the :class:`Receipt`, or raises ``Refused`` with every
            fault, ``Withdrawn``, ``InvalidInput`` or ``StateRepoError``.

        Raises:
            ShuttingDown, QueueFull: where the demand is not taken at all.
        """
        operation = operation or str(uuid.uuid4())
        if not _OPERATION.fullmatch(operation):
            raise ValueError(f"{operation!r} is no operation id; use letters, digits and dashes")
        ticket = Ticket(operation, goal, _now(), listener)
        ticket.future.set_running_or_notify_cancel()  # `withdraw` takes a demand back, not cancel
        try:
            ticket.goal = json.loads(json.dumps(goal))
        except (TypeError, ValueError, RecursionError):
            ticket.future.set_exception(Refused([fault("", "the goal is no plain data")]))
            return ticket
        with self._changed:
            if self._stopping:
                raise ShuttingDown("the generator is shutting down; send the demand again later")
            if len(self._queue) >= self.queue_limit:
                raise QueueFull(
                    f"{self.queue_limit} demands are waiting already; send it again later"
                )
            ticket.base = str(self._snapshot.commit)
            self._enqueue(ticket)
        return ticket

    def _enqueue(self, ticket: Ticket) -> None:
        with self._changed:
            self._queue.append(ticket)
            self._tickets[ticket.operation] = ticket
            self._changed.notify()

    def withdraw(self, operation: str) -> bool:
        """Take a demand back. False once it is committed, or was never known."""
        with self._changed:
            ticket = self._tickets.get(operation)
            if ticket is None or ticket.state != "waiting":
                return ticket is not None and ticket.state == "withdrawn"
            ticket.state = "withdrawn"
            self._slot.outbox.done([operation], durably=True)  # nor may a restart take it up
        return True

    def stop(self, timeout: float = _STOP_TIMEOUT_S) -> Future[bool]:
        """Refuse further demands, finish what is in hand and stop; returns at once.

        Args:
            timeout: seconds to wait for a remote that is away; then what is left stays in the
                outbox for the next start, and its futures raise ``ShuttingDown``.

        Returns:
            A future that tells, when all has ended, whether everything was published.
        """
        with self._changed:
            if self._finished is not None:
                return self._finished
            self._stopping = True
            finished: Future[bool] = Future()
            self._finished = finished
            self._changed.notify()
        threading.Thread(
            target=self._end, args=(timeout, finished), name="demandops-stop", daemon=True
        ).start()
        return finished

    def _end(self, timeout: float, finished: Future[bool]) -> None:
        self._worker.join(timeout)
        self._giving_up.set()
        if self._worker.is_alive():
            self._repository.give_up()
        self._worker.join()
        left = len(self._slot.outbox.pending)
        self._slot.close()
        finished.set_result(not left)

    def close(self, timeout: float = _STOP_TIMEOUT_S) -> bool:
        """Stop and wait for the end; return whether everything was published."""
        return self.stop(timeout).result()

    # ---- the worker thread ----

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._queue and not self._stopping:
                    self._changed.wait()
                if not self._queue:
                    return
            batch: list[Ticket] = []
            try:
                self._settle(batch)
                self._catch_up()
                self._tidy()
            except ShuttingDown as error:
                self._fail(batch, error, keep=True)
            except DemandOpsError as error:
                self._fail(batch, error)
            except Exception as error:
                log.exception("a fault of the generator")
                told = StateRepoError(f"a fault of the generator: {error!r}; its log says more")
                self._fail(batch, told)

    def _take_up(self, batch: list[Ticket]) -> None:
        """Move what waits into the batch, journaled before anything is done with it."""
        with self._changed:  # held while journaling: a demand is taken back before it or after
            room = self._batch_limit - len(batch)
            fresh = [self._queue.popleft() for _ in range(min(room, len(self._queue)))]
            batch += fresh
            self._slot.outbox.append(
                Entry(ticket.operation, ticket.goal, ticket.received.isoformat(), ticket.base)
                for ticket in fresh
                if ticket.state == "waiting" and ticket.operation not in self._slot.outbox.pending
            )

    def _settle(self, batch: list[Ticket]) -> None:
        """Take up what waits and bring it to an end, however often the remote moves."""
        pause = _FIRST_PAUSE_S
        verdict_is_current = self._repository.always_current
        while True:
            self._take_up(batch)
            self._dismiss_withdrawn(batch)
            try:
                line = self._line()
                arrived = self._arrived(line.start, batch)
                results = [(ticket, self._judge(line, ticket, arrived)) for ticket in batch]
                nothing_to_push = line.head.commit == line.start.commit
                if nothing_to_push and not verdict_is_current:
                    # only a push would have shown that the remote has moved
                    tip = self._repository.refresh()
                    verdict_is_current = True
                    if tip != line.start.commit:
                        continue
                if self._publish(line, results):
                    self._answer(batch, results)
                    return
                log.info("the state repo has moved; judging %d demands again", len(batch))
                _doubt(batch, line.start)
                self._repository.refresh()
                pause = min(pause, 1.0)
            except RemoteAway as error:
                _doubt(batch, self._snapshot)
                log.warning("%s; trying again in %.1f s", error, pause)
            if self._giving_up.wait(pause * random.uniform(0.5, 1.0)):  # noqa: S311 - no secret
                raise ShuttingDown(
                    "the remote is away; the demand stays in the outbox for the next start"
                )
            pause = min(pause * 2, _LONGEST_PAUSE_S)

    def _dismiss_withdrawn(self, batch: list[Ticket]) -> None:
        """Answer those that were taken back at once: the remote may be away for long."""
        for ticket in [ticket for ticket in batch if ticket.state == "withdrawn"]:
            batch.remove(ticket)
            self._forget(ticket)
            ticket.future.set_exception(Withdrawn(_TAKEN_BACK))

    def _publish(self, line: writer.Line, results: list[_Result]) -> bool:
        """Publish a line; what the remote denies becomes the answer of all that is in it."""
        try:
            published = line.publish()
        except PushDenied as error:
            results[:] = [(t, error if isinstance(r, Receipt) else r) for t, r in results]
            return True
        if not published:
            return False
        self._snapshot = line.head
        if line.head.commit != line.start.commit:
            self._on_published(line.head.state.catalog)
            self._since_tidy += len(results)
        return True

    def _catch_up(self) -> None:
        """Try again what people changed and could not be carried out: a release may allow it."""
        if self._snapshot.problems:
            line = self._line()
            if line.publish():
                self._snapshot = line.head

    def _tidy(self) -> None:
        """Every few hundred commits: a demand leaves some twenty loose objects behind."""
        if self._since_tidy >= _TIDY_EVERY:
            self._since_tidy = 0
            self._repository.tidy()

    def _line(self) -> writer.Line:
        """Start a line on the newest tip that is known, people's changes taken in."""
        tip = self._repository.tip()
        before = self._snapshot
        if tip == before.commit and not before.problems:
            return writer.Line(self._repository, before)
        advance = snapshots.advance(self._repository.objects, before, tip)
        line = writer.Line(self._repository, advance.snapshot)
        line.follow(advance, before, _now())
        for found in line.head.problems:
            log.error("%s (its last valid version stays in force)", found)
        return line

    def _judge(
        self, line: writer.Line, ticket: Ticket, arrived: dict[str, history.Arrival]
    ) -> Receipt | DemandOpsError:
        if ticket.state == "withdrawn":
            return Withdrawn(_TAKEN_BACK)
        if ticket.operation in arrived:
            return self._published_before(ticket, arrived[ticket.operation])
        try:
            decision = decide(
                line.head.state,
                ticket.goal,
                ticket.received,
                line.read,
                lambda stage: self._tell(ticket, stage, stage),
            )
            if not self._hold(ticket):
                return Withdrawn(_TAKEN_BACK)
            return self._commit(line, ticket, decision)
        except InvalidInput as error:
            line.note(ticket.operation, "Refused")
            return error
        except Exception as error:  # one demand that the program cannot handle stops no other
            log.exception("a fault of the generator, at demand %s", ticket.operation)
            return StateRepoError(f"a fault of the generator: {error!r}; its log says more")

    def _hold(self, ticket: Ticket) -> bool:
        """Make a demand one that cannot be taken back any more; false where it was."""
        with self._changed:
            if ticket.state != "withdrawn":
                ticket.state = "committed"
            return ticket.state == "committed"

    def _commit(self, line: writer.Line, ticket: Ticket, decision: Decision) -> Receipt:
        if decision.files:
            commit = line.commit(decision, ticket.operation, ticket.received, _now())
            self._tell(ticket, "committed", f"committed {commit}")
        else:
            commit = str(line.head.commit)
            line.note(ticket.operation, "Unchanged")
        return Receipt(
            operation=ticket.operation,
            request_id=decision.request.id,
            outcome=decision.outcome,
            commit=commit,
            warnings=decision.warnings,
            not_held=decision.changes.not_held,
        )

    def _arrived(self, start: Snapshot, batch: list[Ticket]) -> dict[str, history.Arrival]:
        """Return operation id → arrival of demands that were published although nobody was told.

        The connection may have been cut, or the process killed, after the remote took the push.
        """
        bases = {ticket.base for ticket in batch if ticket.maybe_published}
        found: dict[str, history.Arrival] = {}
        for base in bases:
            found |= history.operations_since(self._repository.objects, start.commit, base)
        return found

    def _published_before(
        self, ticket: Ticket, arrival: history.Arrival
    ) -> Receipt | DemandOpsError:
        if arrival.outcome == "refused":
            message = "was refused when the connection was cut; send it again to hear why"
            return Refused([fault("", message, code="refused")])
        goal = ticket.goal if isinstance(ticket.goal, dict) else {}
        outcome: Outcome = "released" if goal.get("shutdown") else "booked"
        if arrival.outcome == "unchanged":
            outcome = "unchanged"
        return Receipt(ticket.operation, str(goal.get("id", "")), outcome, arrival.commit)

    def _answer(self, batch: list[Ticket], results: list[_Result]) -> None:
        with self._changed:
            self._slot.outbox.done(ticket.operation for ticket in batch)
        for ticket, result in results:
            self._forget(ticket)
            if isinstance(result, Receipt):
                self._tell(ticket, "pushed", f"pushed {result.commit}")
                ticket.future.set_result(result)
            else:
                ticket.future.set_exception(result)
        batch.clear()

    def _fail(self, batch: list[Ticket], error: DemandOpsError, keep: bool = False) -> None:
        """Answer every demand of a batch with an error; ``keep`` leaves them in the outbox."""
        if not keep:
            with self._changed, suppress(OSError):  # a full disk must not withhold the answer
                self._slot.outbox.done(ticket.operation for ticket in batch)
        for ticket in batch:
            self._forget(ticket)
            ticket.future.set_exception(error)

    def _forget(self, ticket: Ticket) -> None:
        with self._changed:
            ticket.state = "done"
            self._tickets.pop(ticket.operation, None)

    def _tell(self, ticket: Ticket, stage: Stage, text: str) -> None:
        """Tell a stage once, also where a demand is judged again."""
        if stage in ticket.told:
            return
        ticket.told.add(stage)
        try:
            ticket.listener(stage, text)
        except Exception:
            log.exception("a listener failed")


def _ticket_of(entry: Entry) -> Ticket:
    received = datetime.fromisoformat(entry.received)
    ticket = Ticket(entry.operation, entry.goal, received, lambda stage, text: None)
    ticket.base, ticket.maybe_published = entry.base, True
    ticket.future.set_running_or_notify_cancel()
    return ticket


def _doubt(batch: list[Ticket], start: Snapshot) -> None:
    """Note that a push may have been taken although it seemed to fail."""
    for ticket in batch:
        if not ticket.maybe_published:
            ticket.base, ticket.maybe_published = str(start.commit), True


def _now() -> datetime:
    return datetime.now(timezone.utc)
