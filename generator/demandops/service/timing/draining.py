"""Moves placed applications and services off drained nodes.

While any of them cannot move, another attempt is made each minute, and at each change of the
configuration.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from datetime import datetime, timedelta

from demandops.config.config import Config
from demandops.errors import InvalidInput
from demandops.ledger.operations.drain import Drain
from demandops.ledger.world import World
from demandops.runtime import Runtime
from demandops.staterepo.write.commit_batch import CommitBatch

log = logging.getLogger("demandops")

# The pause before a retry to move the applications that stayed on a drained node.
_RETRY = timedelta(seconds=60)


class Draining:
    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._tried: dict[str, tuple[Config, datetime]] = {}
        self._logged: dict[str, frozenset[str]] = {}
        self._after: dict[str, str] = {}

    def move_due(self, commits: CommitBatch) -> None:
        """Commit the moves of placed applications that can leave their drained node now."""
        now = self._runtime.now()
        for node in self._due(commits.head.state, now):
            tried = (commits.head.state.config, now)
            after = self._after.pop(node, "")
            try:
                decision = commits.drain(node, after, self._runtime.fresh_id(), now)
            except InvalidInput as error:
                self._tried[node] = tried
                self._warn(node, map(str, error.faults))
                continue
            # a commit may fail to be published, so only a try without commit is recorded
            assert isinstance(decision.request, Drain)  # noqa: S101 - it was decided
            if decision.request.last:
                self._after[node] = decision.request.last
            elif not decision.files:
                self._tried[node] = tried
            for moved in decision.placed:
                log.info("'%s' is drained: %s", node, moved)
            self._warn(node, decision.warnings, continued=bool(after))

    @property
    def has_more(self) -> bool:
        """Whether the last call left applications for later."""
        return bool(self._after)

    def postpone(self) -> None:
        """Begin again with all applications later."""
        self._after.clear()

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
            is_new = config is not world.config or not at <= now < at + _RETRY
            if is_new and world.ledger.applications_on.get(node):
                nodes.append(node)
        return nodes
