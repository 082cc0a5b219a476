"""The delay until the next attempt to publish, and how many demands to publish at once.

There are two kinds of delays: after another writer published first, and while the remote cannot be
reached. Both kinds are jittered and bounded, so no writer starves, and the writers do not flood a
remote that comes back.
"""

from __future__ import annotations

from demandops.runtime import Runtime

FIRST_PAUSE_S = 0.05
LONGEST_AWAY_S = 10.0
"""The longest delay before the next attempt, while the remote cannot be reached."""
LONGEST_TURN_S = 0.4
"""The longest delay before the next attempt, after another writer published first.

A writer that waits longer would lose again to writers that wait less.
"""
LIMIT_LOCAL = 20
"""The most demands to publish together in a repository on this disk."""
LIMIT_REMOTE = 200
"""The most demands to publish together with one push to a remote.

The limit is higher than :data:`LIMIT_LOCAL`, because a push takes about 50 ms, but moving a branch
of a repository on this disk takes less than 1 ms.
"""

LONGEST_EVALUATION_S = 0.25
"""After this time no further demand of a batch is evaluated, and what was evaluated is published.

The other demands of the batch go back to the queue. In the queue, requesters take turns, so a
demand that arrived meanwhile may come first. So it waits for this time and for one decision, which
has a limit of its own (``limits.decisionMilliseconds``).
"""


class Backoff:
    """The delays of one batch of demands."""

    def __init__(self, limit: int, runtime: Runtime) -> None:
        self._limit, self._runtime = limit, runtime
        self.published()

    def published(self) -> None:
        """Reset the delays and ``max_demands``, because commits were published."""
        self.max_demands = self._limit
        """How many demands the next attempt may publish."""
        self._turn = self._away = FIRST_PAUSE_S

    def overtaken(self, size: int, evaluating_s: float, pushing_s: float) -> float:
        """Return the seconds to wait if another writer published first; adjust ``max_demands``.

        Args:
            size: how many demands the attempt tried to publish.
            evaluating_s: the seconds that the attempt took to evaluate and commit the demands.
            pushing_s: the seconds from the start of the push to its rejection.
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
