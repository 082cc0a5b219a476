"""Which overrides have expired, and when to check again."""

from __future__ import annotations

import logging
from datetime import datetime, timedelta

from demandops.errors import InvalidInput
from demandops.ledger.world import World
from demandops.plan.overrides.lifecycle import expired_overrides
from demandops.staterepo.write.commit_batch import CommitBatch

log = logging.getLogger("demandops")

_RETRY = timedelta(seconds=60)
_SHORTEST_S = 1.0


class OverrideExpiry:
    """Ends each expired override in a commit of its own."""

    def __init__(self) -> None:
        self._failed: dict[tuple[str, datetime], datetime] = {}
        self._not_before: datetime | None = None

    def end_due(self, commits: CommitBatch, now: datetime) -> None:
        """Commit the end of each expired override; retry failed ones later."""
        for override in expired_overrides(commits.head.state, now):
            tried = self._failed.get((override.name, override.end or now))
            if tried is not None and now < tried + _RETRY:
                continue
            try:
                commits.end_override(override, now)
                log.info("%s ended as planned at %s", override.path, override.expires)
            except InvalidInput as error:
                self._failed[override.name, override.end or now] = now
                for problem in error.faults:
                    log.error("%s cannot be ended: %s; trying again later", override.path, problem)

    def postpone(self, now: datetime) -> None:
        """End no override for a while, because the commits could not be published."""
        self._not_before = now + _RETRY

    def is_due(self, world: World, now: datetime) -> bool:
        """Return whether to end an override now."""
        return any(time <= now for time in self._due_times(world))

    def seconds_until_due(self, world: World, now: datetime, longest: float) -> float:
        """Return the seconds until the next check: at least one, at most ``longest``."""
        times = self._due_times(world)
        wait = (min(times) - now).total_seconds() + 0.01 if times else longest
        return min(max(wait, _SHORTEST_S), longest)

    def _due_times(self, world: World) -> list[datetime]:
        return [
            self._due_time(override.name, override.end)
            for override in world.overrides
            if override.end
        ]

    def _due_time(self, name: str, end: datetime) -> datetime:
        tried = self._failed.get((name, end))
        due_time = tried + _RETRY if tried is not None else end
        return max(due_time, self._not_before) if self._not_before else due_time
