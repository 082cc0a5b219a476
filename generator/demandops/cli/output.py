"""The output of commands: tables for people, JSON for programs, errors and progress on stderr.

Functions that need `rich` import it themselves, because `demandops --help` imports this module.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from demandops.base import quoting
from demandops.base.runtime import REAL

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.text import Text

    from demandops.repo.load.snapshot import Snapshot
    from demandops.repo.reader import Reader

_MOST_LISTED = 3

Progress = Callable[[int, int], None]


def console(stderr: bool = False) -> Console:
    from rich.console import Console  # noqa: PLC0415

    class QuotingConsole(Console):
        def render_str(self, text: str, **how: Any) -> Text:  # noqa: ANN401 - as rich has it
            return super().render_str(quoting.lines(text), **how)

    # elsewhere than on a terminal, a program may read the lines, so they are not wrapped
    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else 200
    # rich would take [bold] and :smile: in the texts of people for its own markup
    return QuotingConsole(stderr=stderr, width=width, highlight=False, markup=False, emoji=False)


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


def print_lines(lines: list[str]) -> None:
    text = "".join(f"{line}\n" for line in lines)
    is_long = len(lines) >= shutil.get_terminal_size().lines
    pager = os.environ.get("PAGER")
    if not is_long or pager in ("", "cat") or not (sys.stdin.isatty() and sys.stdout.isatty()):
        click.echo(text, nl=False)
        return
    os.environ.setdefault("LESS", "FRX")  # as in git: show colors, and leave the text on screen
    click.echo_via_pager(text)


class _Errors:
    def print(self, text: str) -> None:
        click.echo(quoting.lines(text), err=True)


errors = _Errors()


def warn_of_problems(repo: Reader, snapshot: Snapshot) -> None:
    for problem in repo.problems_of(snapshot):
        errors.print(f"warning: not in effect: {problem}")
    if snapshot.faults:
        errors.print(f"warning: {in_effect(repo, snapshot)}")


def in_effect(repo: Reader, snapshot: Snapshot) -> str:
    """Tell which configuration is in effect instead of the newest, and how to change that."""
    return (
        f"the configuration of commit {str(snapshot.configuration)[:10]} stays in effect until a "
        f"commit is valid; {repo.how_to_mend(snapshot)}"
    )


def warn_of_not_rendered(paths: Collection[str]) -> None:
    if paths:
        files = "1 generated file" if len(paths) == 1 else f"{len(paths)} generated files"
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
    def value(ctx: click.Context, param: click.Parameter, text: str) -> Any:  # noqa: ANN401
        try:
            return parse(text)
        except ValueError as error:
            raise click.BadParameter(str(error)) from None

    return value


def version_lines(data: Mapping[str, Any]) -> list[str]:
    # of what `json_output.version_data` returns
    asked = data["versions_asked"].items()
    return [
        data["application_version"] or data["version"] or "",
        *(f"{version} requested by {', '.join(requesters)}" for version, requesters in asked),
    ]


def show_slow(text: str) -> None:  # an empty text clears the line
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[2K{quoting.lines(text)}")
        sys.stderr.flush()


@contextmanager
def busy(title: str) -> Iterator[Callable[[str], None]]:
    # on a terminal, the title and the elapsed seconds, if the block takes a second or longer; the
    # function that it yields replaces the title

    def say(text: str) -> None:
        nonlocal title
        title = text

    if not sys.stderr.isatty():
        yield say
        return
    ended, shown = REAL.event(), REAL.event()

    def tick() -> None:
        seconds = 0
        while not ended.wait(1):
            seconds += 1
            shown.set()
            show_slow(f"{title}, {seconds} s")

    thread = REAL.start_thread("busy", tick)
    try:
        yield say
    finally:
        ended.set()
        thread.join()
        if shown.is_set():
            show_slow("")


@contextmanager
def progress(title: str) -> Iterator[Progress]:
    # a progress bar on a terminal, if the work takes long
    start = REAL.monotonic()
    bar: Bar | None = None
    task: Any = None

    def show(done: int, total: int) -> None:
        nonlocal bar, task
        if bar is None:
            if not sys.stderr.isatty() or REAL.monotonic() - start < 0.5 or done >= total:
                return
            from rich.progress import Progress as Bar  # noqa: PLC0415

            bar = Bar(console=console(stderr=True), transient=True)
            task = bar.add_task(title, total=total)
            bar.start()
        bar.update(task, completed=done, total=total)

    try:
        yield show
    finally:
        if bar is not None:
            bar.stop()
