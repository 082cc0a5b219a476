"""The work that becomes due without a new demand: drains, ends of leases and overrides, waiting."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from concurrent.futures import Future
from datetime import datetime, timedelta, timezone

from demandops.base.errors import InvalidInput, OverLimit
from demandops.base.quoting import quoted
from demandops.base.runtime import Runtime
from demandops.decide.booking import Drain
from demandops.decide.decision import decide
from demandops.decide.placement.relocation import expired_overrides
from demandops.decide.state import State
from demandops.model.config.config import Config
from demandops.model.demand.claim import Claim
from demandops.model.demand.demand_request import Expire
from demandops.model.ledger.ledger import Ledger, World
from demandops.model.ledger.records import Instance, in_turn
from demandops.repo.write.commit_batch import CommitBatch
from demandops.serve.queue import Receipt, Ticket
from demandops.serve.timing.timers import within

# ---- drained nodes: placed applications and services move off them ----
#
# While any of them cannot move, another attempt is made each minute, and at each change of the
# configuration.

log = logging.getLogger("demandops")

# The pause before a retry to move the applications that stayed on a drained node.
_RETRY_DRAINING = timedelta(seconds=60)


class Draining:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._tried: dict[str, tuple[Config, datetime]] = {}
        self._logged: dict[str, frozenset[str]] = {}
        # by node: the last application that was moved, if others are left for later
        self.after: dict[str, str] = {}

    def move_due(self, commits: CommitBatch) -> None:
        now = self._runtime.now()
        for node in self._due(commits.head.state, now):
            tried = (commits.head.state.config, now)
            after = self.after.pop(node, "")
            try:
                decision = commits.drain(node, after, self._runtime.fresh_id(), now)
            except InvalidInput as error:
                self._tried[node] = tried
                self._warn(node, map(str, error.faults))
                continue
            # a commit may fail to be published, so only a try without commit is recorded
            assert isinstance(decision.request, Drain)  # noqa: S101 - it was decided
            if decision.request.last:
                self.after[node] = decision.request.last
            elif not decision.files:
                self._tried[node] = tried
            for moved in decision.placed:
                log.info("'%s' is drained: %s", node, moved)
            self._warn(node, decision.warnings, continued=bool(after))

    def _warn(self, node: str, stays: Iterable[str], *, continued: bool = False) -> None:
        # the texts of the last try are not logged again, as a try comes each minute
        texts, logged = frozenset(stays), self._logged.get(node, frozenset())
        for text in sorted(texts - logged):
            log.warning("'%s' is drained: %s", node, text)
        self._logged[node] = texts | logged if continued else texts

    def is_due(self, world: World) -> bool:
        return bool(self._due(world, self._runtime.now()))

    def _due(self, world: World, now: datetime) -> list[str]:
        nodes = []
        for node in world.config.drained_nodes:
            # not for a minute after a try, unless a person changed the configuration or the clock
            config, at = self._tried.get(node, (None, now))
            is_new = config is not world.config or not at <= now < at + _RETRY_DRAINING
            if is_new and world.ledger.applications_on.get(node):
                nodes.append(node)
        return nodes


# ---- ends of leases, overrides and kept replicas ----
#
# A person may set the clock. A clock that is set back only delays the end of a lease. A clock that
# jumps forward would end leases that were renewed in time, so after a jump every lease gets its
# full term again. The sleep of a machine looks like a jump and has the same effect. Overrides and
# kept replicas get no more time after a jump.

# By how much the clock may gain on the monotonic clock before leases get their full term again.
_JUMP = timedelta(seconds=30)
# The ledger keeps a lease that has ended if its release failed, or if it got more time after a jump
# of the clock. Without this minimum, the worker would then never wait.
_SHORTEST_S = 1.0
# The longest time between two checks of the leases; short, because a person may set the clock.
LONGEST_WAIT_S = 60.0
# The pause after a failed try to end a lease or an override, or to scale down.
_RETRY = timedelta(seconds=LONGEST_WAIT_S)


class LeaseExpiry:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._last = (runtime.now(), runtime.monotonic())
        self._jumped_at: datetime | None = None
        self._tried: dict[str, datetime] = {}
        self._first: object = None
        self._next_end: datetime | None = None

    def tickets(self, ledger: Ledger) -> list[Ticket]:
        # The tickets are correct only now: later, a requester may renew a lease, or a person may
        # set the clock. If one does not release its claims, the next comes at least a minute later.
        now, claims = self.ended_claims(ledger)
        ended = dict.fromkeys(claim.demand for claim in claims)
        # forget demands that were released or renewed meanwhile
        self._tried = {d: at for d, at in self._tried.items() if at > now - _RETRY and d in ended}
        return [self._ticket(demand, now) for demand in ended if demand not in self._tried]

    def _ticket(self, demand: str, now: datetime) -> Ticket:
        ticket = Ticket(self._runtime.fresh_id(), Expire(id=demand, demand=demand), now)

        def tell(future: Future[Receipt]) -> None:
            self._tried[demand] = now
            error = future.exception()
            if isinstance(error, InvalidInput):  # no client gets this error, so report it here
                self._runtime.failed(f"end of the lease of {quoted(demand)}", error)
            elif error is None:
                outcome = future.result().outcome
                log.info("the lease of %s has ended: %s", quoted(demand), outcome)

        ticket.future.add_done_callback(tell)
        return ticket

    def ended_claims(self, ledger: Ledger) -> tuple[datetime, list[Claim]]:
        """Return the current time, and the claims whose lease has ended, earliest end first."""
        now = self._read_clocks()
        ended = ledger.ended_claims(now)
        # A demand's claims are released together. So if one gets more time after a jump of the
        # clock, none is released.
        granted = {claim.demand for claim in ended if not self._has_ended(claim, now)}
        return now, [claim for claim in ended if claim.demand not in granted]

    def seconds_until_due(self, ledger: Ledger, longest: float) -> float:
        first = ledger.first_to_end()
        if first is not self._first:  # a search is slow if many leases end at one time
            self._first, self._next_end = first, ledger.next_lease_end()
        end = self._next_end
        return longest if end is None else _seconds_until(end, self._read_clocks(), longest)

    def _read_clocks(self) -> datetime:
        wall, steady = self._runtime.now(), self._runtime.monotonic()
        expected = self._last[0] + timedelta(seconds=steady - self._last[1])
        if wall - expected > _JUMP:
            jump = (wall - expected).total_seconds()
            log.warning("the clock jumped forward by %.0f s, so leases get their full term", jump)
            self._jumped_at = wall
        self._last = (wall, steady)
        return wall

    def _has_ended(self, claim: Claim, now: datetime) -> bool:
        if claim.lease is None or self._jumped_at is None:
            return claim.lease is not None
        return now > self._jumped_at + timedelta(seconds=claim.lease.seconds + claim.lease.slack)


class OverrideExpiry:
    def __init__(self) -> None:
        # By name and end: an override whose end a person changes is tried again at once.
        self._retry_at: dict[tuple[str, datetime | None], datetime] = {}
        # Before this time no end counts as due, but each batch of demands still commits the ends.
        self.not_before = datetime.min.replace(tzinfo=timezone.utc)

    def end_due(self, commits: CommitBatch, now: datetime) -> None:
        for override in expired_overrides(commits.head.state, now):
            if self._retry_at.get((override.name, override.end), now) > now:
                continue
            try:
                commits.end_override(override, now)
                log.info("%s ended as planned at %s", override.path, override.expires)
            except InvalidInput as error:
                self._retry_at[override.name, override.end] = now + _RETRY
                for problem in error.faults:
                    log.error("%s cannot be ended: %s; trying again later", override.path, problem)

    def is_due(self, world: World, now: datetime) -> bool:
        return any(time <= now for time in self._due_times(world))

    def seconds_until_due(self, world: World, now: datetime, longest: float) -> float:
        times = self._due_times(world)
        return _seconds_until(min(times), now, longest) if times else longest

    def _due_times(self, world: World) -> list[datetime]:
        return [
            max(self._retry_at.get((override.name, override.end), override.end), self.not_before)
            for override in world.overrides
            if override.end
        ]


class ScaleDown:
    def __init__(self) -> None:
        self._retry_at: dict[Instance, datetime] = {}
        self.not_before = datetime.min.replace(tzinfo=timezone.utc)

    def end_due(self, commits: CommitBatch, now: datetime) -> None:
        for instance in commits.head.state.ledger.kept.due(now):
            if self._retry_at.get(instance, now) > now:
                continue
            try:
                log.info("%s", commits.scale_down(instance, now))
                self._retry_at.pop(instance, None)
            except InvalidInput as error:
                self._retry_at[instance] = now + _RETRY
                for problem in error.faults:
                    log.error("cannot scale down: %s; trying again later", problem)
                if isinstance(error, OverLimit):  # the next may take as long, and demands wait
                    break

    def is_due(self, ledger: Ledger, now: datetime) -> bool:
        if now < self.not_before:
            return False
        return any(self._retry_at.get(due, now) <= now for due in ledger.kept.due(now))

    def seconds_until_due(self, ledger: Ledger, now: datetime, longest: float) -> float:
        end = ledger.kept.next_end()
        return longest if end is None else _seconds_until(max(end, self.not_before), now, longest)


def _seconds_until(time: datetime, now: datetime, longest: float) -> float:
    return min(max((time - now).total_seconds() + 0.01, _SHORTEST_S), longest)


# ---- the demands that wait for room: when they are tried again, and in which order ----
#
# If there may be room, the generator tries the waiting demands before it decides new demands. So no
# demand gets the room for which an earlier demand, or a demand of higher priority, was waiting.

# After this processor time, new demands come before the waiting demands that were not tried yet.
_LONGEST_ROUND_S = 0.25


class WaitingTurns:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._tried: World | None = None
        self.left: list[str] = []  # demands that the last round left for later

    def book_due(self, commits: CommitBatch) -> None:
        state = commits.head.state
        if not self.is_due(state):
            return
        if not self._is_tried(state) or not self.left:
            self.left = [waiting.demand for waiting in in_turn(state.ledger.waiting)]
        end = self._runtime.processor_s() + _LONGEST_ROUND_S
        while self.left:
            demand = self.left.pop(0)
            state, now = commits.head.state, self._runtime.now()
            waiting = state.ledger.waiting.get(demand)
            if waiting is None:  # it was released meanwhile
                continue
            checkpoint = within(state.config.repo_settings.limits, self._runtime)
            try:
                decision = decide(
                    state, dict(waiting.goal), now, commits.read, checkpoint=checkpoint
                )
            except InvalidInput as error:
                log.debug("demand %s still waits: %s", quoted(demand), error)
                if isinstance(error, OverLimit):  # a template took too long, and the next may too
                    break
            else:
                if decision.outcome == "booked" and not decision.approval:
                    commits.commit(decision, self._runtime.fresh_id(), waiting.since, now)
                    log.info("demand %s no longer waits", quoted(demand))
            if self._runtime.processor_s() > end:  # after a try, so that each round gets on
                break
        self._tried = commits.head.state

    def follow(self, commits: CommitBatch, before: State) -> None:
        """Book waiting demands if the last demand, decided on ``before``, freed room."""
        if commits.frees:
            commits.frees = False
            self._tried = None
            self.book_due(commits)
        elif self._tried is before:  # the last demand freed no room, so the tries are still valid
            self._tried = commits.head.state

    def is_due(self, state: State) -> bool:
        return bool(state.ledger.waiting) and (bool(self.left) or not self._is_tried(state))

    def _is_tried(self, state: World) -> bool:
        # by identity: ledger and configuration are frozen, and to compare their content takes long
        tried = self._tried
        return tried is not None and tried.ledger is state.ledger and tried.config is state.config


# ---- all of this work, in its order ----


class OwnWork:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._override_expiry = OverrideExpiry()
        self._scale_down = ScaleDown()
        self._draining = Draining(runtime)
        self._waiting_turns = WaitingTurns(runtime)

    def commit_due(self, commits: CommitBatch) -> None:
        # a scale-down frees room for what moves, and what runs moves before what waits is booked
        self._override_expiry.end_due(commits, self._runtime.now())
        self._scale_down.end_due(commits, self._runtime.now())
        self._draining.move_due(commits)
        self._waiting_turns.book_due(commits)

    def follow(self, commits: CommitBatch, before: State) -> None:
        self._waiting_turns.follow(commits, before)

    def postpone(self) -> None:
        # because a fetch or a publication failed
        later = self._runtime.now() + _RETRY
        self._override_expiry.not_before = self._scale_down.not_before = later
        self._draining.after.clear()
        self._waiting_turns.left.clear()

    def is_due(self, state: State) -> bool:
        now = self._runtime.now()
        return (
            self._override_expiry.is_due(state, now)
            or self._scale_down.is_due(state.ledger, now)
            or self._draining.is_due(state)
            or self._waiting_turns.is_due(state)
        )

    def seconds_until_due(self, state: State, longest: float) -> float:
        # what was left off goes on at once, but after the demands that arrived meanwhile
        if self._draining.after or self._waiting_turns.left:
            return 0.0
        now = self._runtime.now()
        seconds = self._override_expiry.seconds_until_due(state, now, longest)
        return self._scale_down.seconds_until_due(state.ledger, now, seconds)
