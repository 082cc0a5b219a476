"""The work that becomes due without a new demand: drains, ends of leases and overrides, waiting."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from datetime import datetime

from demandops.base.errors import InvalidInput, OverLimit
from demandops.base.quoting import quoted
from demandops.base.runtime import Runtime
from demandops.decide.booking import Drain
from demandops.decide.decision import decide
from demandops.decide.state import State
from demandops.model.config.config import Config
from demandops.model.ledger.ledger import World
from demandops.model.ledger.records import in_turn
from demandops.repo.write.commit_batch import CommitBatch
from demandops.serve.timing.expiry import RETRY, OverrideExpiry
from demandops.serve.timing.pauses_and_limits import within

# ---- drained nodes: placed applications and services move off them ----
#
# While any of them cannot move, another attempt is made each minute, and at each change of the
# configuration.

log = logging.getLogger("demandops")


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
            is_new = config is not world.config or not at <= now < at + RETRY
            if is_new and world.ledger.applications_on.get(node):
                nodes.append(node)
        return nodes


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
            if (waiting := state.ledger.waiting.get(demand)) is None:  # it was released meanwhile
                continue
            checkpoint = within(state.config.repo_settings.limits, self._runtime)
            try:
                decision = decide(state, waiting.put, now, commits.read, checkpoint=checkpoint)
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
        """Book waiting demands if the last demand, decided on ``before``, may have let them in."""
        if commits.awaited:
            commits.awaited = False
            self._tried = None
            self.book_due(commits)
        elif self._tried is before:  # the last demand let none in, so the tries are still valid
            self._tried = commits.head.state

    def is_due(self, state: State) -> bool:
        return bool(state.ledger.waiting) and (bool(self.left) or not self._is_tried(state))

    def _is_tried(self, state: World) -> bool:
        # by identity: ledger and configuration are frozen, and to compare their content takes long
        tried = self._tried
        return tried is not None and tried.ledger is state.ledger and tried.config is state.config


# ---- all of this work, in its order ----


class Agenda:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._override_expiry = OverrideExpiry()
        self._draining = Draining(runtime)
        self.waiting_turns = WaitingTurns(runtime)

    def commit_due(self, commits: CommitBatch) -> None:
        # what runs moves before what waits is booked
        self._override_expiry.end_due(commits, self._runtime.now())
        self._draining.move_due(commits)
        self.waiting_turns.book_due(commits)

    def postpone(self) -> None:
        # because a fetch or a publication failed
        self._override_expiry.not_before = self._runtime.now() + RETRY
        self._draining.after.clear()
        self.waiting_turns.left.clear()

    def is_due(self, state: State) -> bool:
        return (
            self._override_expiry.is_due(state, self._runtime.now())
            or self._draining.is_due(state)
            or self.waiting_turns.is_due(state)
        )

    def seconds_until_due(self, state: State, longest: float) -> float:
        # what was left off goes on at once, but after the demands that arrived meanwhile
        if self._draining.after or self.waiting_turns.left:
            return 0.0
        return self._override_expiry.seconds_until_due(state, self._runtime.now(), longest)
