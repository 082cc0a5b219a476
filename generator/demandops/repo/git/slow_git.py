"""Informs a listener (the terminal of a command) when git takes long with a remote."""

from __future__ import annotations

from collections.abc import Callable

AFTER_S = 1  # how many seconds git may take before the listener is called

_listeners: list[Callable[[str], None]] = []


def listen(listener: Callable[[str], None]) -> None:
    # It replaces the earlier one. A slow run of git calls it each second with a text about what git
    # does, and with an empty text when git has ended.
    _listeners[:] = [listener]


class SlowGit:
    def __init__(self, what: str) -> None:
        self._what, self._told = what, 0

    def lasts(self, seconds: float) -> None:
        if int(seconds) > self._told and int(seconds) >= AFTER_S:
            self._told = int(seconds)
            for listener in _listeners:
                listener(f"{self._what}, {self._told} s")

    def ends(self) -> None:
        for listener in _listeners if self._told else ():
            listener("")
