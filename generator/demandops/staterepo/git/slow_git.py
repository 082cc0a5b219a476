"""Tells a listener, the terminal of a command, that git takes long with a remote."""

from __future__ import annotations

from collections.abc import Callable

AFTER_S = 1
"""How long git may take before anybody is told."""

_listeners: list[Callable[[str], None]] = []


def listen(listener: Callable[[str], None]) -> None:
    """Call ``listener`` each second with what git does, and with an empty text at its end."""
    _listeners[:] = [listener]


class SlowGit:
    """One run of git, and how long it takes."""

    def __init__(self, what: str) -> None:
        self._what, self._told = what, 0

    def lasts(self, seconds: float) -> None:
        """Tell the listener after :data:`AFTER_S`, once for each second."""
        if int(seconds) > self._told and int(seconds) >= AFTER_S:
            self._told = int(seconds)
            for listener in _listeners:
                listener(f"{self._what}, {self._told} s")

    def ends(self) -> None:
        """Tell the listener that there is nothing to show any longer."""
        for listener in _listeners if self._told else ():
            listener("")
