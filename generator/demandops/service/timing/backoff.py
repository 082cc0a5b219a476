"""The delay until the next attempt to publish, and how many demands to publish at once.

There are two kinds of delays: after another writer published first, and while the remote cannot be
reached. Both kinds are jittered and bounded, so no writer starves, and the writers do not flood a
remote that comes back.
"""

from __future__ import annotations

from demandops.runtime import Runtime

FIRST_PAUSE_S = 0.05
# While the remote cannot be reached.
LONGEST_AWAY_S = 10.0
# After another writer published first; a writer that waits longer loses again to the others.
LONGEST_TURN_S = 0.4
# The most demands to publish together. A push takes about 50 ms, but moving a branch of a
# repository on this disk takes less than 1 ms.
LIMIT_LOCAL = 20
LIMIT_REMOTE = 200

# After this time, what was evaluated of a batch is published, and the other demands go back to the
# queue. There, requesters take turns, so a demand that arrived meanwhile may come first. So it
# waits for this time and for one decision, which has a limit too (limits.decisionMilliseconds).
LONGEST_EVALUATION_S = 0.25


class Backoff:
    def __init__(self, limit: int, runtime: Runtime) -> None:
        self._limit, self._runtime = limit, runtime
        self.published()

    def published(self) -> None:
        """Reset the delays and ``max_demands``, because commits were published."""
        self.max_demands = self._limit
        self._turn = self._away = FIRST_PAUSE_S

    def overtaken(self, size: int, evaluating_s: float, pushing_s: float) -> float:
        """Return the seconds to wait if another writer published first; adjust ``max_demands``.

        ``size`` counts the demands that the attempt tried to publish, and ``evaluating_s`` the
        seconds until it had decided and committed them. ``pushing_s`` goes on until the rejection
        of the push.
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
