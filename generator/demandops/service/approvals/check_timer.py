"""When to check the proposals: soon after main moved, else at an interval."""

from __future__ import annotations

from demandops.runtime import Runtime

CHECK_EMBEDDED_S = 1.0
CHECK_REMOTE_S = 5.0
"""The interval between checks of the branches; only a check shows that a branch was deleted."""
_PAUSE_FACTOR = 9
"""The pause after a check, as a multiple of its duration, so checks take a tenth of the time."""


class CheckTimer:
    """The times of the checks. After a check that failed, the next one waits for the interval."""

    def __init__(self, runtime: Runtime, *, embedded: bool) -> None:
        self._runtime = runtime
        self._interval = CHECK_EMBEDDED_S if embedded else CHECK_REMOTE_S
        self._checked_at: str | None = ""
        self._began = self._rest_until = self._next = 0.0

    def is_due(self, tip: str, *, has_news: bool) -> bool:
        """Return whether to check now, with main at ``tip``.

        With ``has_news`` a check is due at once, unless the last check failed.
        """
        if has_news and self._checked_at is not None:
            return True
        return self.seconds_until_due(tip) <= 0

    def seconds_until_due(self, tip: str) -> float:
        """Return the seconds until the next check; zero or less if it is due."""
        has_moved = self._checked_at not in (tip, None)
        due = min(self._next, self._rest_until) if has_moved else self._next
        return due - self._runtime.monotonic()

    def began(self) -> None:
        """Plan the next check, in case the check that begins now fails."""
        self._began = self._runtime.monotonic()
        self._next, self._checked_at = self._began + self._interval, None

    def ended(self, tip: str) -> None:
        """Note that all proposals were checked with main at ``tip``."""
        now = self._runtime.monotonic()
        self._checked_at = tip
        self._rest_until = now + _PAUSE_FACTOR * (now - self._began)
