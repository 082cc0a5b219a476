"""The delay until the next attempt to publish, and how many demands to publish at once.

Two cases have delays of their own: another writer was first, or the remote cannot be reached. Both
are jittered and bounded, so no writer starves and a remote that comes back is not flooded.
"""

from __future__ import annotations

from demandops.runtime import Runtime

FIRST_PAUSE_S = 0.05
LONGEST_AWAY_S = 10.0
"""The longest delay while the remote cannot be reached."""
LONGEST_TURN_S = 0.4
"""The longest delay after another writer was first; with longer ones a writer loses again."""
LIMIT_EMBEDDED = 20
LIMIT_REMOTE = 200
"""How many demands to publish together: a push costs some 50 ms, moving a branch less than one."""


class Backoff:
    """The delays of one batch of demands."""

    def __init__(self, limit: int, runtime: Runtime) -> None:
        self._limit, self._runtime = limit, runtime
        self.published()

    def published(self) -> None:
        """Reset the delays, because commits were published."""
        self.max_demands = self._limit
        """How many demands to publish next."""
        self._turn = self._away = FIRST_PAUSE_S

    def overtaken(self, size: int, evaluating_s: float, pushing_s: float) -> float:
        """Return the seconds to wait after another writer was first.

        Args:
            size: how many demands were to be published.
            evaluating_s: seconds that it took to evaluate and commit them.
            pushing_s: seconds until the push was rejected.
        """
        # a writer that evaluates for longer than its push takes always loses to faster writers
        self.max_demands = max(1, int(size * min(1.0, pushing_s / max(evaluating_s, 1e-9))))
        wait, self._turn = self._turn, min(self._turn * 2, LONGEST_TURN_S)
        self._away = FIRST_PAUSE_S
        return self._jittered(wait)

    def unreachable(self) -> float:
        """Return the seconds to wait after the remote could not be reached."""
        wait, self._away = self._away, min(self._away * 2, LONGEST_AWAY_S)
        return self._jittered(wait)

    def _jittered(self, seconds: float) -> float:
        return seconds * self._runtime.uniform(0.5, 1.0)
