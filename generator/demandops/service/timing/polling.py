"""When to fetch from the state repo while no demand comes.

This module does not fetch; the caller fetches, and reports the end of each fetch.
"""

from __future__ import annotations

import re

from demandops.config.durations import seconds_of
from demandops.runtime import Runtime

DEFAULT_INTERVAL = "30s"
_LONGEST_BACKOFF_S = 60.0
# A Git server may report many pushes at once; they share a fetch.
_SHORTEST_GAP_S = 0.5
# The longest interval for a repository on this disk, where a check is cheap: it reads one file.
_LOCAL_S = 1.0


def parse_interval(text: str) -> float:
    """Return an interval in seconds, from a duration like ``30s`` or a number of seconds.

    ValueError is raised if the text is neither of them.
    """
    if re.fullmatch(r"[0-9]{1,8}(\.[0-9]{1,6})?", text):
        return float(text)
    return float(seconds_of(text))


class PollTimer:
    """Decides when to fetch: on request, and at an interval that grows while fetches fail.

    Any thread may call :meth:`request`. Only one thread may call the other methods.
    """

    def __init__(self, interval: float, runtime: Runtime, *, local: bool = False) -> None:
        """Start the timer. With an interval of 0, only :meth:`request` makes a fetch due."""
        self._interval = min(interval, _LOCAL_S) if local else interval
        self._runtime = runtime
        self._pause = self._interval
        self._last = runtime.monotonic() - _SHORTEST_GAP_S
        self._next = runtime.monotonic() if interval else None
        self._requested = runtime.event()

    def request(self) -> None:
        """Make a fetch due now, or half a second after the last one, if that is later."""
        self._requested.set()

    def seconds_until_due(self) -> float | None:
        times = [] if self._next is None else [self._next]
        if self._requested.is_set():
            times.append(self._last + _SHORTEST_GAP_S)
        return max(min(times) - self._runtime.monotonic(), 0.0) if times else None

    def start_if_due(self) -> bool:
        due = self.seconds_until_due() == 0.0
        if due:  # clear before the fetch: a later push needs another one
            self._requested.clear()
        return due

    def finished(self, *, reached: bool) -> None:
        """Plan the next fetch after a fetch or a push, which both tell of others' commits."""
        longest = max(_LONGEST_BACKOFF_S, self._interval)
        self._last = self._runtime.monotonic()
        if self._next is not None:
            self._pause = self._interval if reached else min(self._pause * 2, longest)
            # a little less at random, so that generators do not fetch all at once
            self._next = self._last + self._pause * self._runtime.uniform(0.8, 1.0)
