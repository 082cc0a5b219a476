"""Which overrides are over, and when to look again; one that could not be ended waits a while."""

from __future__ import annotations

import logging
from datetime import datetime, timedelta

from demandops.config.config import Config
from demandops.errors import InvalidInput
from demandops.plan.overrides.lifecycle import expired_overrides
from demandops.staterepo.write.commit_line import CommitLine

log = logging.getLogger("demandops")

_AGAIN = timedelta(seconds=60)
_SHORTEST_S = 1.0


class OverrideClock:
    """Ends overrides at their time, each in a commit of its own."""

    def __init__(self) -> None:
        self._failed: dict[tuple[str, datetime], datetime] = {}
        self._not_before: datetime | None = None

    def end(self, line: CommitLine, now: datetime) -> None:
        """Commit on a line that what is over has ended; what cannot be carried out stays."""
        for override in expired_overrides(line.head.state.config, now):
            tried = self._failed.get((override.name, override.end or now))
            if tried is not None and now < tried + _AGAIN:
                continue
            try:
                line.end(override, now)
                log.info("%s ended at its time, %s", override.path, override.expires)
            except InvalidInput as error:
                self._failed[override.name, override.end or now] = now
                for found in error.faults:
                    log.error("%s cannot be ended: %s (trying again later)", override.path, found)

    def put_off(self, now: datetime) -> None:
        """Wait a while before anything is ended again: it could not be published."""
        self._not_before = now + _AGAIN

    def anything(self, config: Config, now: datetime) -> bool:
        """Tell whether an override is to be ended now."""
        return any(
            self._when(one.name, one.end) <= now for one in config.active_overrides if one.end
        )

    def pause(self, config: Config, now: datetime, longest: float) -> float:
        """Return the seconds until the next look is due: ``longest`` at most, one at least."""
        ends = [self._when(one.name, one.end) for one in config.active_overrides if one.end]
        wait = min((end - now).total_seconds() + 0.01 for end in ends) if ends else longest
        return min(max(wait, _SHORTEST_S), longest)

    def _when(self, name: str, end: datetime) -> datetime:
        tried = self._failed.get((name, end))
        again = tried + _AGAIN if tried is not None else end
        return max(again, self._not_before) if self._not_before else again
