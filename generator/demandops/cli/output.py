"""What commands print: tables for people, JSON for programs, errors and progress on stderr."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click
from rich.console import Console
from rich.progress import Progress as Bar

F = TypeVar("F", bound=Callable[..., Any])

_WIDE = 200
_PATIENCE_S = 0.5

Progress = Callable[[int, int], None]


def _console(stderr: bool) -> Console:
    """Return a console; where no terminal reads, nothing is coloured and little is wrapped."""
    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else _WIDE
    return Console(stderr=stderr, width=width, highlight=False, markup=False, emoji=False)


SIGNS = {"start": "+", "change": "~", "stop": "-"}
"""How a release that starts, changes or stops is marked."""

REV_HELP = "A commit, tag or branch, or a time like 2026-01-31T14:03, 14:03 (UTC) or 2h"


class _Errors:
    """Plain lines on stderr, whole whatever the width of the terminal."""

    def print(self, text: str) -> None:
        click.echo("".join(char if char in "\n\t" else _visible(char) for char in text), err=True)


def _visible(char: str) -> str:
    """Return a character as it is, or escaped where it would act on the terminal."""
    return char if char.isprintable() else char.encode("unicode_escape").decode()


errors = _Errors()


def console() -> Console:
    """Return the console of the moment's standard output."""
    return _console(stderr=False)


def warn_of(problems: Iterable[object]) -> None:
    """Tell files that are not valid, for which their last valid version was taken."""
    for found in problems:
        errors.print(f"warning: {found} (its last valid version is taken)")


def print_json(data: object) -> None:
    """Print ``data`` as JSON."""
    click.echo(json.dumps(data, indent=2, ensure_ascii=False))


state_repo_option = click.option(
    "--state-repo",
    "state_repo",
    required=True,
    envvar="DEMANDOPS_STATE_REPO",
    metavar="URL_OR_DIR",
    help="The state repo: a folder with a bare repository, or a URL that git clones "
    "[env: DEMANDOPS_STATE_REPO].",
)

signing_option = click.option(
    "--signing-key",
    "signing_key",
    envvar="DEMANDOPS_SIGNING_KEY",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Sign the commits with this SSH key: a private key without a passphrase, or the public "
    "one of a key that an agent holds; see docs/audit.md [env: DEMANDOPS_SIGNING_KEY].",
)

output_option = click.option(
    "--output",
    "output",
    type=click.Choice(["text", "json"]),
    default="text",
    show_default=True,
    help="How to print.",
)


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """Give a function that shows progress on a terminal once the work takes a while."""
    start = time.monotonic()
    bar: Bar | None = None
    task: Any = None

    def tell(done: int, total: int) -> None:
        nonlocal bar, task
        if bar is None:
            if not sys.stderr.isatty() or time.monotonic() - start < _PATIENCE_S or done >= total:
                return
            bar = Bar(console=_console(stderr=True), transient=True)
            task = bar.add_task(what, total=total)
            bar.start()
        bar.update(task, completed=done, total=total)

    try:
        yield tell
    finally:
        if bar is not None:
            bar.stop()
