"""The output of commands: text and its pager, errors and progress on stderr, and the streams."""

from __future__ import annotations

import io
import os
import shutil
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import click

from demandops.base import quoting
from demandops.base.runtime import REAL

_MOST_LISTED = 3

Progress = Callable[[int, int], None]


# What the command has changed already, to be told if its output cannot be written.
done: list[str] = []


class OutputLost(Exception):
    """Raised when the standard output is closed or full; no library catches it by chance."""


class _Output(io.TextIOWrapper):
    def write(self, text: str, /) -> int:
        try:
            return super().write(text)
        except OSError as error:
            raise OutputLost(error.strerror) from error

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            raise OutputLost(error.strerror) from error


def open_streams() -> None:
    """Give the process three standard streams, of which none raises an error of its encoding."""
    # The next file would get the number of a closed one, and what a child prints would land in it.
    # What is opened for reading refuses each write, and so tells that the output was closed.
    for number, mode in enumerate((os.O_RDONLY, os.O_RDONLY, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)
    sys.stdin = sys.stdin or open(0, closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115
    stream = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    assert isinstance(stream, io.TextIOWrapper)  # noqa: S101
    assert isinstance(sys.stderr, io.TextIOWrapper)  # noqa: S101
    encoding, is_terminal = stream.encoding, stream.isatty()
    raw = stream.detach()
    sys.stdout = _Output(raw, encoding, "backslashreplace", line_buffering=is_terminal)
    sys.stderr.reconfigure(errors="backslashreplace")


# What is printed before the name of a changed release or entry.
SIGNS = {"start": "+", "change": "~", "stop": "-", "added": "+", "changed": "~", "removed": "-"}


def terminal_width() -> int | None:
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def painted(text: str, style: str) -> str:
    # NO_COLOR is a convention of many programs: https://no-color.org
    colors = sys.stdout.isatty() and not os.environ.get("NO_COLOR")
    if not colors or not style or os.environ.get("TERM") == "dumb":
        return text
    if style in ("bold", "dim"):
        return click.style(text, **{style: True})
    return click.style(text, fg=style)


def say(text: str) -> None:
    click.echo(quoting.lines(text))


def print_lines(lines: list[str]) -> None:
    text = "".join(f"{line}\n" for line in lines)
    is_long = len(lines) >= shutil.get_terminal_size().lines
    pager = os.environ.get("PAGER")
    if not is_long or pager in ("", "cat") or not (sys.stdin.isatty() and sys.stdout.isatty()):
        click.echo(text, nl=False)
        return
    os.environ.setdefault("LESS", "FRX")  # as in git: show colors, and leave the text on screen
    click.echo_via_pager(text)


def fitted(text: str, width: int | None) -> str:
    """Return text whose lines are wrapped between words, with a deeper indent, to fit the width."""
    lines = text.split("\n")
    for at, line in enumerate(lines):
        if width is not None and len(line) > width and " " in line.strip():
            indent = " " * (len(line) - len(line.lstrip()) + 4)
            words = textwrap.TextWrapper(width, subsequent_indent=indent, break_on_hyphens=False)
            words.break_long_words = False
            lines[at] = words.fill(line)
    return "\n".join(lines)


class _Errors:
    def print(self, text: str) -> None:
        width = shutil.get_terminal_size().columns if sys.stderr.isatty() else None
        with suppress(OSError):  # nothing else can tell it
            click.echo(fitted(quoting.lines(text), width), err=True)


errors = _Errors()


def warn_of_not_rendered(paths: Collection[str]) -> None:
    if paths:
        files = quoting.count(len(paths), "generated file")
        listed = ", ".join(sorted(paths)[:_MOST_LISTED])
        more = ", …" if len(paths) > _MOST_LISTED else ""
        errors.print(f"warning: a generator has yet to write or remove {files}: {listed}{more}")


at_option = click.option(
    "--at",
    metavar="REV|TIME",
    help="A commit, tag or branch, or a time like 2026-01-31T14:03, 14:03 (UTC) or 2h; default: "
    "the newest commit, or in a checkout the one that is checked out.",
)


def read_by(parse: Callable[[str], Any]) -> Callable[..., Any]:
    def value(ctx: click.Context, param: click.Parameter, given: Any) -> Any:  # noqa: ANN401
        try:
            return tuple(map(parse, given)) if isinstance(given, tuple) else parse(given)
        except ValueError as error:
            raise click.BadParameter(str(error)) from None

    return value


def show_slow(text: str) -> None:  # an empty text clears the line
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[2K{quoting.lines(text)}")
        sys.stderr.flush()


@contextmanager
def busy(title: str) -> Iterator[Progress]:
    # on a terminal, the title, how far the block says that it is, and the elapsed seconds, if it
    # takes a second or longer
    ended, reached = REAL.event(), ""

    def report(done: int, total: int) -> None:
        nonlocal reached
        reached = f", {done} of {total}"

    def tick() -> None:
        seconds = 0
        while not ended.wait(1):
            seconds += 1
            show_slow(f"{title}{reached}, {seconds} s")

    thread = REAL.start_thread("busy", tick) if sys.stderr.isatty() else None
    try:
        yield report
    finally:
        ended.set()
        if thread is not None:
            thread.join()
            show_slow("")
