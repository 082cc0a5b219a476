"""When to check the proposals: soon after main has moved, and otherwise at an interval."""

from __future__ import annotations

from demandops.runtime import Runtime

CHECK_LOCAL_S = 1.0
"""The seconds between two checks of the branches in a repository on this disk."""
CHECK_REMOTE_S = 5.0
"""The seconds between two checks of a remote's branches; only a check detects a deleted branch."""
_PAUSE_FACTOR = 9
"""The pause before a check of a new main, as a multiple of the time that the last check took.

The pause is at most the interval between two checks.
"""


class CheckTimer:
    """Decides when the next check is due. A failed check is retried when the interval is over."""

    def __init__(self, runtime: Runtime, *, local: bool) -> None:
        self._runtime = runtime
        self._interval = CHECK_LOCAL_S if local else CHECK_REMOTE_S
        self._checked_at: str | None = ""
        self._began = self._rest_until = self._next = 0.0

    def is_due(self, tip: str, *, has_news: bool) -> bool:
        """Return whether to check now; ``tip`` is the newest commit of main.

        ``has_news`` is true if a proposal has changed. A check is then due at once, unless the last
        check failed.
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
        """Record that a check begins, and plan the next one in case this one fails."""
        self._began = self._runtime.monotonic()
        self._next, self._checked_at = self._began + self._interval, None

    def ended(self, tip: str) -> None:
        """Record that a check with main at ``tip`` has ended."""
        now = self._runtime.monotonic()
        self._checked_at = tip
        self._rest_until = now + _PAUSE_FACTOR * (now - self._began)
