"""Settling: a batch of demands is judged, committed and published, however often the remote moves.

Belongs to one thread, the only one that writes to the state repo.
"""

from __future__ import annotations

import logging
import random
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import TypeAlias

from generator.catalog.catalog import Catalog
from generator.decision import Decision, Outcome, decide
from generator.demand import leaving
from generator.demand.request import DemandRequest, Operation
from generator.errors import (
    DemandOpsError,
    InvalidInput,
    Refused,
    ShuttingDown,
    StateRepoError,
    Withdrawn,
    fault,
)
from generator.service import rollback
from generator.service.approval import GIVEN_UP, Approvals, Deferred
from generator.service.expiry import LeaseClock
from generator.service.following import Follower
from generator.service.overriding import OverrideClock
from generator.service.targets import of_decision as targets_of
from generator.service.throttle import Throttle
from generator.service.ticket import Receipt, Ticket
from generator.service.waiting import TAKEN_BACK, Waiting
from generator.staterepo import history, writer
from generator.staterepo.ahead import Ahead
from generator.staterepo.repository import PushDenied, RemoteAway, StateRepository
from generator.staterepo.signing import SigningFailed
from generator.staterepo.snapshot import Snapshot

log = logging.getLogger("demandops")

_FIRST_PAUSE_S = 0.05
_LONGEST_PAUSE_S = 10.0
"""Between two tries of a remote that is away."""
_LONGEST_TURN_S = 1.0
"""Between two tries where another writer was first."""
_BATCH_LIMIT_EMBEDDED = 20
_BATCH_LIMIT_REMOTE = 200
"""Demands that are published together: a push costs some 50 ms, moving a branch less than one."""
_TIDY_EVERY = 300
_LONGEST_WAIT_S = 60.0
"""Between two looks at the leases: a clock may be set meanwhile."""

_Result: TypeAlias = tuple[Ticket, Receipt | DemandOpsError | Deferred]


class Settler:
    """Turns batches of demands into published commits.

    ``snapshot`` is the newest published state; it may be read from any thread.
    """

    def __init__(
        self,
        repository: StateRepository,
        snapshot: Snapshot,
        waiting: Waiting,
        on_published: Callable[[Catalog], None],
        with_targets: bool,
        approvals: Approvals,
        fetch_interval: float = 0.0,
    ) -> None:
        self.snapshot = snapshot
        self._approvals = approvals
        self._repository = repository
        self._waiting = waiting
        self._on_published = on_published
        self._with_targets = with_targets
        self._since_tidy = 0
        self._throttle = Throttle()
        self._clock = LeaseClock()
        self._overrides = OverrideClock()
        self._tried: dict[str, datetime] = {}
        self._ahead = Ahead()
        self._giving_up = threading.Event()
        embedded = repository.always_current
        self.follower = Follower(repository, waiting, fetch_interval, self._line, self._taken)
        self._batch_limit = _BATCH_LIMIT_EMBEDDED if embedded else _BATCH_LIMIT_REMOTE

    def give_up(self) -> None:
        """Stop waiting for a remote that is away; from any thread."""
        self._giving_up.set()
        self.follower.give_up()
        self._repository.give_up()
        self._waiting.wake()

    def take_up(self, batch: list[Ticket]) -> None:
        """Move what waits into ``batch``, and behind it the demands whose lease ran out.

        A renewal that waits was received before: it is judged first, or nothing expires yet.
        """
        self._take_up(batch)
        if not self._waiting.anything:
            batch += self.expired()

    def _take_up(self, batch: list[Ticket]) -> None:
        self._waiting.take_up(batch, self._batch_limit)
        self._approvals.resume(batch, self.snapshot.state)

    def settle(self, batch: list[Ticket]) -> None:
        """Bring a batch to an end, with what comes in while the remote moves, and empty it.

        Raises:
            ShuttingDown: where it was given up; the demands are still in the batch.
            DemandOpsError: where the state repo cannot be used; likewise.
        """
        pause = away = _FIRST_PAUSE_S
        share = self._batch_limit
        verdict_is_current = self._repository.always_current
        stale = False
        while batch:
            try:
                # of a remote that is away nothing is judged: what is committed stays in
                if stale or self.follower.link.is_away:
                    self._repository.refresh()
                    stale, verdict_is_current = False, True
                self._waiting.dismiss_withdrawn(batch)
                part = batch[:share]
                self._approvals.give_up(part, self.snapshot.state)
                line = self._line()
                arrived = self._arrived(line.start, part)
                began = time.monotonic()
                results: list[_Result] = []
                for ticket in part:
                    results.append((ticket, self._judge(line, ticket, arrived, results)))
                judged = time.monotonic()
                nothing_to_push = line.head.commit == line.start.commit
                if nothing_to_push and not verdict_is_current:
                    # only a push would have shown that the remote has moved
                    tip = self._repository.refresh()
                    verdict_is_current = True
                    if tip != line.start.commit:
                        continue
                if self._publish(line, results):
                    self._answer(results)
                    del batch[: len(part)]
                    pause, away, share = _FIRST_PAUSE_S, _FIRST_PAUSE_S, self._batch_limit
                    continue
                log.info("the state repo has moved; judging %d demands again", len(part))
                _doubt(part, line.start)
                # judging for longer than the push takes loses to faster writers for ever
                pushing = (time.monotonic() - judged) / max(judged - began, 1e-9)
                share = max(1, int(len(part) * min(1.0, pushing)))
                wait, pause = pause, min(pause * 2, _LONGEST_TURN_S)
                stale, away = True, _FIRST_PAUSE_S
            except RemoteAway as error:
                _doubt(batch, self.snapshot)
                self.follower.out_of_touch(error)
                verdict_is_current = self._repository.always_current
                wait, away = away, min(away * 2, _LONGEST_PAUSE_S)
            # waited before the fetch: what is judged then is pushed while it is fresh
            self._linger(batch, wait * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
            if self._giving_up.is_set():
                raise ShuttingDown(
                    "the remote is away; the demand stays in the outbox for the next start"
                )
            self._take_up(batch)

    def _answer(self, results: list[_Result]) -> None:
        """Answer what is settled; what needs approval waits on."""
        told = [(ticket, result) for ticket, result in results if not isinstance(result, Deferred)]
        self._waiting.answer(told)
        for ticket, result in results:
            if isinstance(result, Deferred):
                self._approvals.take(ticket, result.decision)

    def attend(self) -> None:
        """Look after the demands that await approval, with main as it is now."""
        if not self._approvals.is_due(str(self.snapshot.commit)):
            return
        try:
            heads = self._approvals.heads()
            if heads.main != str(self.snapshot.commit):
                self._repository.refresh()
                self.follower.catch_up()
            # a branch that is gone may have been merged: only a newer main tells
            if self._repository.includes(str(self.snapshot.commit), heads.main):
                self._approvals.look(self.snapshot, heads)
        except (RemoteAway, PushDenied) as error:
            log.warning("%s; the demands that await approval wait on", error)

    def _linger(self, batch: list[Ticket], seconds: float) -> None:
        """Let a while pass; demands that come in meanwhile are kept, and told why they wait."""
        end = time.monotonic() + seconds
        told = list(batch)
        while not self._giving_up.is_set():
            if self.follower.link.is_away:
                for ticket in told:
                    ticket.tell("away", f"waiting: {self.follower.link.contact.trouble}")
            self._waiting.dismiss_withdrawn(batch)
            left = end - time.monotonic()
            if left <= 0:
                return
            told = self._waiting.keep(left)

    def pause(self) -> float:
        """Return the seconds until leases, overrides, proposals or the state repo are due."""
        state = self.snapshot.state
        ends = self._clock.pause(state.ledger, self._approvals.pause(_LONGEST_WAIT_S))
        ends = self._overrides.pause(state.catalog, _now(), ends)
        look = self.follower.pause()
        return ends if look is None else min(ends, look)

    def expired(self) -> list[Ticket]:
        """Return a ticket for each demand whose lease ran out; nobody waits for its receipt.

        One that cannot be released (its files do not render) is tried again after a while.
        """
        now, claims = self._clock.ended(self.snapshot.state.ledger)
        since = now - timedelta(seconds=_LONGEST_WAIT_S)
        over = dict.fromkeys(claim.demand for claim in claims)
        tried = self._tried  # what is over no more was released or renewed
        self._tried = {d: when for d, when in tried.items() if when > since and d in over}
        demands = [demand for demand in over if demand not in self._tried]
        requests = [
            DemandRequest(id=demand, operation=Operation.EXPIRE, demand=demand)
            for demand in demands
        ]
        self._tried |= dict.fromkeys(demands, now)
        return [
            Ticket(str(uuid.uuid4()), request, now, lambda stage, text: None)
            for request in requests
        ]

    def catch_up(self) -> None:
        """Try again what people changed and could not be carried out: a release may allow it."""
        if self.snapshot.problems:
            self.follower.catch_up()

    def notice(self) -> None:
        """Take in what others published, while no demand comes, and end overrides."""
        due = self._overrides.anything(self.snapshot.state.catalog, _now())
        if not self.follower.notice(self.snapshot, due):
            self._overrides.put_off(_now())

    def tidy(self) -> None:
        """Every few hundred commits: a demand leaves some twenty loose objects behind."""
        if self._since_tidy >= _TIDY_EVERY:
            self._since_tidy = 0
            self._repository.tidy()

    def _publish(self, line: writer.Line, results: list[_Result]) -> bool:
        """Publish a line; what the remote denies becomes the answer of all that is in it."""
        try:
            published = line.publish()
        except PushDenied as error:
            results[:] = [(t, error if isinstance(r, Receipt) else r) for t, r in results]
            self.follower.link.denied(str(error))
            return True
        if not published:
            return False
        self.follower.in_touch(pushed=line.head.commit != line.start.commit)
        self._taken(line)
        self._since_tidy += len(results)
        return True

    def _taken(self, line: writer.Line) -> None:
        before, self.snapshot = self.snapshot, line.head
        if line.head.commit != before.commit:  # a merge may ask for no commit of our own
            self._on_published(line.head.state.catalog)

    def _line(self) -> writer.Line:
        """Start a line on the newest tip that is known, people's changes taken in."""
        tip = self._repository.tip()
        before = self.snapshot
        if tip == before.commit and not before.problems:
            line = writer.Line(self._repository, before)
            self._overrides.end(line, _now())
            return line
        advance = self._ahead.advance(self._repository.objects, before, tip)
        line = writer.Line(self._repository, advance.snapshot)
        line.follow(advance, before, _now())
        self.follower.tell(line.head.problems)
        self._overrides.end(line, _now())
        return line

    def _judge(
        self,
        line: writer.Line,
        ticket: Ticket,
        arrived: dict[str, history.Arrival],
        earlier: list[_Result],
    ) -> Receipt | DemandOpsError | Deferred:
        if ticket.state == "withdrawn":
            return Withdrawn(TAKEN_BACK)
        if ticket.operation in arrived:
            return _published_before(ticket, arrived[ticket.operation])
        try:
            gone = self._approvals.gave_up(ticket, line.head.state, earlier)
            earlier[:] = [
                (t, Withdrawn(GIVEN_UP) if t.operation in gone else r) for t, r in earlier
            ]
            goal = ticket.goal
            if rollback.is_rollback(goal):
                goal = rollback.understood(goal, self._repository, line.start)
            decision = decide(
                line.head.state,
                goal,
                ticket.received,
                line.read,
                lambda stage: ticket.tell(stage, stage),
                lambda request, catalog: self._throttle.faults(
                    request, catalog, ticket.operation, ticket.received
                ),
            )
            if decision.approval:
                return Deferred(decision)
            if not self._waiting.hold(ticket):
                return Withdrawn(TAKEN_BACK)
            self._approvals.replaced_by(decision.request)
            before = line.head.state.ledger
            targets = targets_of(before, decision) if self._with_targets else ()
            return replace(_commit(line, ticket, decision), targets=targets)
        except InvalidInput as error:
            if self._approvals.released(ticket):  # what was proposed, and nothing else
                line.note(ticket.operation, "Unchanged")
                return _released(ticket, str(line.head.commit))
            line.note(ticket.operation, "Refused")
            return error
        except SigningFailed as error:
            return error
        except Exception as error:  # one demand that the program cannot handle stops no other
            log.exception("a fault of the generator, at demand %s", ticket.operation)
            return StateRepoError(f"a fault of the generator: {error!r}; its log says more")

    def _arrived(self, start: Snapshot, batch: list[Ticket]) -> dict[str, history.Arrival]:
        """Return operation id → arrival of demands that were published although nobody was told.

        The connection may have been cut, or the process killed, after the remote took the push.
        """
        bases = {ticket.base for ticket in batch if ticket.maybe_published}
        found: dict[str, history.Arrival] = {}
        for base in bases:
            found |= history.operations_since(self._repository.objects, start.commit, base)
        return found


def _commit(line: writer.Line, ticket: Ticket, decision: Decision) -> Receipt:
    if decision.files:
        commit = line.commit(decision, ticket.operation, ticket.received, _now())
        ticket.tell("committed", f"committed {commit}")
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
        lease_s=decision.lease_s,
        changes=decision.changes.claims,
    )


def _published_before(ticket: Ticket, arrival: history.Arrival) -> Receipt | DemandOpsError:
    if arrival.outcome == "refused":
        message = "was refused when the connection was cut; send it again to hear why"
        return Refused([fault("", message, code="refused")])
    goal = ticket.goal if isinstance(ticket.goal, dict) else {}
    gives_up = goal.get("shutdown") or goal.get("operation") == Operation.RELEASE.value
    gives_up = gives_up or leaving.is_leaving(goal)
    outcome: Outcome = "released" if gives_up else "booked"
    if rollback.is_rollback(goal):
        outcome = "restored"
    if arrival.outcome == "unchanged":
        outcome = "unchanged"
    name = goal.get("id") or goal.get("request") or goal.get("demand") or goal.get("name") or ""
    return Receipt(ticket.operation, str(name), outcome, arrival.commit)


def _released(ticket: Ticket, commit: str) -> Receipt:
    goal = ticket.goal
    name = goal.get("id") or goal.get("request") or goal.get("demand") or ""
    return Receipt(ticket.operation, str(name), "released", commit)


def _doubt(batch: list[Ticket], start: Snapshot) -> None:
    for ticket in batch:
        ticket.doubt(str(start.commit))


def _now() -> datetime:
    return datetime.now(timezone.utc)
