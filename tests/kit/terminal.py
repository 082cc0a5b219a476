"""A terminal of a given size, for commands that run in this process."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


class Screen:
    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def read(self, master: int) -> None:
        while True:
            try:
                part = os.read(master, 65536)
            except OSError:
                return
            if not part:
                return
            self._parts.append(part)

    @property
    def text(self) -> str:
        return b"".join(self._parts).decode().replace("\r\n", "\n")


@contextmanager
def terminal(
    monkeypatch: pytest.MonkeyPatch, columns: int = 80, lines: int = 1000
) -> Iterator[Screen]:
    """Make standard output a terminal for a block; the screen is complete after the block."""
    master, slave = os.openpty()
    screen = Screen()
    reading = threading.Thread(target=screen.read, args=(master,))
    reading.start()
    try:
        with monkeypatch.context() as patch, os.fdopen(slave, "w") as out:
            patch.setenv("COLUMNS", str(columns))
            patch.setenv("LINES", str(lines))
            patch.setenv("TERM", "xterm-256color")
            patch.setattr(sys, "stdout", out)
            yield screen
    finally:
        reading.join()
        os.close(master)
