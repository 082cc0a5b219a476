"""The command line: run in this process, on a terminal, or in a dialogue with a person."""

from __future__ import annotations

import io
import json
import os
import pty
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.kit.limits import PATIENCE_S


class Ran(NamedTuple):
    code: int
    out: str
    err: str

    def json(self) -> Any:
        return json.loads(self.out)


Run = Callable[..., Ran]


def runner(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    from demandops.cli.main import run

    def call(*args: str | Path, stdin: str | bytes = "") -> Ran:
        capsys.readouterr()
        given = io.BytesIO(stdin.encode() if isinstance(stdin, str) else stdin)
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(given, "utf-8"))
        code = run([str(arg) for arg in args])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err, err
        return Ran(code, out, err)

    return call


PROGRAM = (sys.executable, "-m", "demandops.cli.main")


def process(*command: object, **options: Any) -> Ran:
    """Run a program to its end, which must come in time."""
    given = {"capture_output": True, "text": True, "timeout": PATIENCE_S} | options
    done = subprocess.run([*map(str, command)], check=False, **given)
    return Ran(done.returncode, done.stdout, done.stderr)


# ---- on a terminal of a given size ----


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


# ---- in a dialogue ----

CTRL_C = "\x03"
_SILENCE_S = 30.0  # far longer than a busy machine takes to end a command


class Dialogue:
    """``demandops`` with a pseudoterminal as its standard input, output and error."""

    def __init__(self, *args: str | Path, folder: Path | None = None, **environment: str) -> None:
        self.text, self._typed, self._typed_at = "", b"", 0
        self._pid, self._master = pty.fork()
        if self._pid == 0:
            os.chdir(folder or Path.cwd())
            os.environ.update(environment, TERM="xterm", COLUMNS="80", LINES="40", PAGER="cat")
            os.execv(sys.executable, [*PROGRAM, *map(str, args)])  # noqa: S606 - no shell is needed

    def __enter__(self) -> Dialogue:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pid:
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)
        os.close(self._master)

    def read_until(self, wanted: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while wanted not in self.text:
            assert self._read(end - time.monotonic()), f"no {wanted!r} in:\n{self.text}"

    def type(self, text: str) -> None:
        self._typed, self._typed_at = text.encode(), len(self.text)
        os.write(self._master, self._typed)

    def end(self) -> int:
        """Read until the command ends; return its exit code.

        If the command prints nothing for so long, repeat the last text that was typed, such as
        Ctrl-C: Python can miss a Ctrl-C just before it begins to read. Do not repeat the text if
        the command has printed something since, because a second Ctrl-C would kill a command that
        is ending.
        """
        end = time.monotonic() + PATIENCE_S
        while self._read(_SILENCE_S) or self._runs_on():
            assert time.monotonic() < end, f"the command has not ended:\n{self.text}"
        _, status = os.waitpid(self._pid, 0)
        self._pid = 0
        return os.waitstatus_to_exitcode(status)

    def _runs_on(self) -> bool:
        """Return whether the command runs; if it ignored the typed text, type the text again."""
        if select.select([self._master], [], [], 0)[0]:
            return self._read(0)
        if not self.text[self._typed_at :].strip("^C\r\n"):
            os.write(self._master, self._typed)
        return True

    def _read(self, wait_s: float) -> bool:
        """Append new output to ``text``; return False if none comes in time, or no more."""
        if not select.select([self._master], [], [], max(wait_s, 0))[0]:
            return False
        try:
            part = os.read(self._master, 65536)
        except OSError:  # Linux: the other end is closed
            return False
        self.text += part.decode("utf-8", "replace").replace("\r\n", "\n")
        return bool(part)
