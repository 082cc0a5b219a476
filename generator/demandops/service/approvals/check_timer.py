"""When to check the proposals: soon after main has moved, and otherwise at an interval."""

from __future__ import annotations

from demandops.runtime import Runtime

# The seconds between two checks of the branches, as only a check detects a deleted branch.
CHECK_LOCAL_S = 1.0
CHECK_REMOTE_S = 5.0
# How many times as long as the last check to pause before the check of a new main, so that checks
# take at most a tenth of the worker's time while main moves.
_PAUSE_FACTOR = 9


class CheckTimer:
    """Decides when the next check is due. A failed check is retried when the interval is over."""

    def __init__(self, runtime: Runtime, *, local: bool) -> None:
        self._runtime = runtime
        self._interval = CHECK_LOCAL_S if local else CHECK_REMOTE_S
        self._checked_at: str | None = ""
        self._began = self._rest_until = self._next = 0.0

    def is_due(self, tip: str, *, has_news: bool) -> bool:
        # after a failed check, news wait for the interval: the remote is likely away
        if has_news and self._checked_at is not None:
            return True
        return self.seconds_until_due(tip) <= 0

    def seconds_until_due(self, tip: str) -> float:
        has_moved = self._checked_at not in (tip, None)
        due = min(self._next, self._rest_until) if has_moved else self._next
        return due - self._runtime.monotonic()

    def began(self) -> None:
        """Record that a check begins, and plan the next one in case this one fails."""
        self._began = self._runtime.monotonic()
        self._next, self._checked_at = self._began + self._interval, None

    def ended(self, tip: str) -> None:
        now = self._runtime.monotonic()
        self._checked_at = tip
        self._rest_until = now + _PAUSE_FACTOR * (now - self._began)
