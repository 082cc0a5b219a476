"""Informs a listener (the terminal of a command) when git takes long with a remote."""

from __future__ import annotations

from collections.abc import Callable

_listeners: list[Callable[[str], None]] = []


def listen(listener: Callable[[str], None]) -> None:
    # It replaces the earlier one. A slow run of git calls it each second with a text about what git
    # does, and with an empty text when git has ended.
    _listeners[:] = [listener]


def tell(text: str) -> None:
    for listener in _listeners:
        listener(text)
