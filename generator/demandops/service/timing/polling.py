"""When to look whether others changed the state repo, and what is known of reaching it.

Pure but for the clock that it is given. Knows nothing of Git: told of each look, it says when the
next is due, and logs once that the remote went away and once that it is back.
"""

from __future__ import annotations

import random
import re
import threading
import time
from collections.abc import Callable

from demandops.config.policy import seconds_of

DEFAULT_INTERVAL = "30s"
_LONGEST_BACKOFF_S = 60.0
_SHORTEST_GAP_S = 0.5
_EMBEDDED_S = 1.0
"""A repository on this disk is looked at this often at least: it is one file that is read."""


def parse_interval(text: str) -> float:
    """Return the seconds of a fetch interval: a duration like ``30s``, or seconds; 0: never.

    Raises:
        ValueError: where it is none.
    """
    if re.fullmatch(r"[0-9]{1,8}(\.[0-9]{1,6})?", text):
        return float(text)
    return float(seconds_of(text))


def _jittered(interval: float) -> float:
    """Return a little less than the interval: a change is to be seen within it."""
    return interval * random.uniform(0.8, 1.0)  # noqa: S311 - no secret


class PollTimer:
    """The times of the looks: at an interval, seldomer while the remote is away, and when told.

    ``nudge`` may be called from any thread, the rest belongs to one.
    """

    def __init__(
        self,
        interval: float,
        *,
        embedded: bool = False,
        steady: Callable[[], float] = time.monotonic,
        jittered: Callable[[float], float] = _jittered,
    ) -> None:
        """Begin; the first look is due at once.

        Args:
            interval: seconds between two looks; 0: only those that :meth:`nudge` asks for.
            embedded: whether a look costs next to nothing.
            steady: gives the time in seconds.
            jittered: shortens a pause by chance, so that generators do not all look at once.
        """
        self._interval = min(interval, _EMBEDDED_S) if embedded else interval
        self._steady, self._jittered = steady, jittered
        self._pause = self._interval
        self._last = -_SHORTEST_GAP_S + steady()
        self._next = steady() if interval else None
        self._requested = threading.Event()

    def request(self) -> None:
        """Have a look taken at once; however often it is asked for meanwhile, it is one."""
        self._requested.set()

    def seconds_until_due(self) -> float | None:
        """Return the seconds until the next look is due; nothing: none is."""
        times = [] if self._next is None else [self._next]
        if self._requested.is_set():
            times.append(self._last + _SHORTEST_GAP_S)
        return max(min(times) - self._steady(), 0.0) if times else None

    def start_if_due(self) -> bool:
        """Tell whether a look is due; what is asked for from now on is another one."""
        due = self.seconds_until_due() == 0.0
        if due:
            self._requested.clear()
        return due

    def finished(self, *, reached: bool) -> None:
        """Note that the state repo was asked for what is new, here or by a push."""
        longest = max(_LONGEST_BACKOFF_S, self._interval)
        self._last = self._steady()
        if self._next is not None:
            self._pause = self._interval if reached else min(self._pause * 2, longest)
            self._next = self._last + self._jittered(self._pause)

    def interrupted(self) -> None:
        """Note that a look was cut short: it is still due."""
        self._requested.set()
