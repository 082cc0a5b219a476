"""Informs a listener (the terminal of a command) when git takes long with a remote."""

from __future__ import annotations

from collections.abc import Callable

AFTER_S = 1
"""How many seconds git may take before the listener is called."""

_listeners: list[Callable[[str], None]] = []


def listen(listener: Callable[[str], None]) -> None:
    """Call ``listener`` each second with what git does, and with an empty text when git ends."""
    _listeners[:] = [listener]


class SlowGit:
    """One run of git, and how long it takes."""

    def __init__(self, what: str) -> None:
        self._what, self._told = what, 0

    def lasts(self, seconds: float) -> None:
        """Call the listener once a second, after :data:`AFTER_S`."""
        if int(seconds) > self._told and int(seconds) >= AFTER_S:
            self._told = int(seconds)
            for listener in _listeners:
                listener(f"{self._what}, {self._told} s")

    def ends(self) -> None:
        """Call the listener with an empty text, so that it clears what it shows."""
        for listener in _listeners if self._told else ():
            listener("")
