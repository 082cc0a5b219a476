"""How long a line of commits may be, and how long to wait before the next try.

Other writers may be first, and the remote may be away: two waits of their own, both jittered and
bounded, so that no writer is overtaken for ever and a remote that comes back is not stormed.
"""

from __future__ import annotations

import random

FIRST_PAUSE_S = 0.05
LONGEST_AWAY_S = 10.0
"""Between two tries of a remote that is away."""
LONGEST_TURN_S = 0.4
"""Between two tries where another writer was first: it goes on at once, so who waits long loses."""
LIMIT_EMBEDDED = 20
LIMIT_REMOTE = 200
"""Demands that are published together: a push costs some 50 ms, moving a branch less than one."""


class Backoff:
    """Begins anew with each batch; told of each try, it gives the seconds until the next."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.published()

    def published(self) -> None:
        """Note that a line was published."""
        self.max_demands = self._limit
        """How many demands the next line may have."""
        self._turn = self._away = FIRST_PAUSE_S

    def overtaken(self, size: int, judging_s: float, pushing_s: float) -> float:
        """Note that another writer was first.

        Args:
            size: how many demands the line had.
            judging_s: seconds that it took to lay it.
            pushing_s: seconds until it was known that it came too late.
        """
        # judging for longer than the push takes loses to faster writers for ever
        self.max_demands = max(1, int(size * min(1.0, pushing_s / max(judging_s, 1e-9))))
        wait, self._turn = self._turn, min(self._turn * 2, LONGEST_TURN_S)
        self._away = FIRST_PAUSE_S
        return _jittered(wait)

    def unreachable(self) -> float:
        """Note that the remote could not be reached."""
        wait, self._away = self._away, min(self._away * 2, LONGEST_AWAY_S)
        return _jittered(wait)


def _jittered(seconds: float) -> float:
    return seconds * random.uniform(0.5, 1.0)  # noqa: S311 - no secret
