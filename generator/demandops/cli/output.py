"""The output of commands: tables for people, JSON for programs, errors and progress on stderr.

`rich` is imported by what needs it, because `demandops --help` imports this module.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from demandops.quoting import lines
from demandops.runtime import REAL

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.text import Text

_WIDE = 200
_PATIENCE_S = 0.5

Progress = Callable[[int, int], None]


def console(stderr: bool = False) -> Console:
    """Return a console; if the stream is not a terminal, it is wide and has no colors."""
    from rich.console import Console  # noqa: PLC0415

    class QuotingConsole(Console):
        """A console that escapes control characters, in lines and in tables."""

        def render_str(self, text: str, **how: Any) -> Text:  # noqa: ANN401 - as rich has it
            return super().render_str(lines(text), **how)

    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else _WIDE
    return QuotingConsole(stderr=stderr, width=width, highlight=False, markup=False, emoji=False)


SIGNS = {"start": "+", "change": "~", "stop": "-", "added": "+", "changed": "~", "removed": "-"}
"""The mark of a release or an entry, by its change."""


class _Errors:
    """Prints plain lines on stderr, never wrapped."""

    def print(self, text: str) -> None:
        click.echo(lines(text), err=True)


errors = _Errors()


def warn_of(problems: Iterable[object]) -> None:
    """Warn about invalid files whose last valid version is in effect."""
    for problem in problems:
        errors.print(f"warning: {problem}; its last valid version is in effect")


state_repo_option = click.option(
    "--state-repo",
    required=True,
    envvar="DEMANDOPS_STATE_REPO",
    metavar="URL_OR_DIR",
    help="The state repo: a bare repository's folder, or a URL that git can clone "
    "[env: DEMANDOPS_STATE_REPO].",
)

signing_option = click.option(
    "--signing-key",
    envvar="DEMANDOPS_SIGNING_KEY",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Sign the commits with this SSH key: a private key without a passphrase, or the public "
    "key of a key in an SSH agent; see docs/audit.md [env: DEMANDOPS_SIGNING_KEY].",
)

at_option = click.option(
    "--at",
    metavar="REV|TIME",
    help="A commit, tag or branch, or a time like 2026-01-31T14:03, 14:03 (UTC) or 2h; default: "
    "the newest commit.",
)


def version_text(data: Mapping[str, Any]) -> str:
    """Return the version that a service runs, and below it the versions that demands name."""
    asked = data["versions_asked"].items()
    return "\n".join(
        [
            data["application_version"] or data["version"] or "",
            *(f"{version} asked by {', '.join(requesters)}" for version, requesters in asked),
        ]
    )


@contextmanager
def progress(title: str) -> Iterator[Progress]:
    """Yield a function that shows a progress bar, on a terminal and if the work takes long."""
    start = REAL.monotonic()
    bar: Bar | None = None
    task: Any = None

    def show(done: int, total: int) -> None:
        nonlocal bar, task
        if bar is None:
            if not sys.stderr.isatty() or REAL.monotonic() - start < _PATIENCE_S or done >= total:
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
