"""A terminal of a given size, for commands that run in this process."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import pytest


@dataclass
class Screen:
    """All text that was printed on a terminal, once its block has ended."""

    text: str = ""


@contextmanager
def terminal(
    monkeypatch: pytest.MonkeyPatch, columns: int = 80, lines: int = 1000
) -> Iterator[Screen]:
    """Make standard output a terminal for the length of a block."""
    master, slave = os.openpty()
    screen, printed = Screen(), list[bytes]()

    def read() -> None:
        with suppress(OSError):  # how Linux reports that the other end is closed
            while part := os.read(master, 65536):
                printed.append(part)

    reading = threading.Thread(target=read)
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
        screen.text = b"".join(printed).decode().replace("\r\n", "\n")
