"""Shared parts of the commands by which a person edits the state repo."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from demandops.cli.output import errors
from demandops.repo import reader
from demandops.repo.git.signing import Signer
from demandops.repo.history.commit_log import Person
from demandops.repo.reader import Reader

reason_option = click.option(
    "-m",
    "--reason",
    metavar="TEXT",
    callback=lambda ctx, param, text: " ".join((text or "").split()),
    help="The reason. It is written to the commit message and to the file of a new override.",
)
yes_option = click.option("-y", "--yes", is_flag=True, help="Do not ask for confirmation.")


def is_asked(yes: bool, output: str) -> bool:
    return not yes and output == "text" and sys.stdin.isatty()


def confirm(question: str, yes: bool, output: str) -> None:
    if is_asked(yes, output) and not click.confirm(question, err=True):
        raise click.ClickException("nothing was changed")


def warned_if_unnamed(person: Person) -> Person:
    if not person.is_known:
        errors.print(
            f"warning: git does not know who you are, so the commit's author is {person}; to "
            'change that: git config --global user.name "Your Name" and '
            "git config --global user.email you@example.org"
        )
    return person


@contextmanager
def writable(
    state_repo: str, signing_key: Path | None, *, dry_run: bool = False
) -> Iterator[Reader]:
    # a dry run writes nothing, so the state repo may also be a checkout
    with reader.opened(state_repo, only_read=dry_run) as repo:
        repo.repository.signer = Signer(signing_key) if signing_key else None
        yield repo
