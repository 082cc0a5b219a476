"""Authors: which person made a commit or caused a follow commit, and who runs this program.

A follow commit is made by the generator, and renders what people committed. Its trailers name
people's commits, and its author names these people. A commit is by a person if no generator on any
machine made it, or if it is of a proposal (:mod:`.commit_log`).
"""

from __future__ import annotations

import getpass
import os
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from functools import cache
from typing import NamedTuple

import git
import pygit2
from pygit2 import Commit, Oid, Repository

from demandops.config.config import CONFIG_ROOTS
from demandops.ledger.claim_file import LEDGER_ROOT
from demandops.settings import GENERATED_ROOTS, NOTES_ROOT
from demandops.staterepo.git import tree as trees
from demandops.staterepo.history import commit_log, commit_message

_ROOTS = (*CONFIG_ROOTS, LEDGER_ROOT, *GENERATED_ROOTS, NOTES_ROOT)
_MOST_NAMED = 20
_NO_ADDRESS = "@demandops.invalid"


class Person(NamedTuple):
    """The name and e-mail address of a person; ``str`` gives ``name <email>``, as git does."""

    name: str
    email: str

    @property
    def is_known(self) -> bool:
        """Whether git knows the address. If not, the address is ``<login>@demandops.invalid``."""
        return not self.email.endswith(_NO_ADDRESS)

    def __str__(self) -> str:
        return f"{self.name} <{self.email}>"


def person_commits_since(repo: Repository, known: Oid, to: Oid) -> list[Commit]:
    """Return people's commits since ``known`` that change files of the generator, newest first."""
    commits = commit_log.person_commits(repo, to, known)
    return [commit for commit in commits if _touches(commit, _ROOTS)]


def fault_origin(repo: Repository, known: Oid, to: Oid) -> Callable[[str], tuple[str, str] | None]:
    """Return a function from a file with a fault to the id and author of the commit that caused it.

    This is the last person's commit that changed the file, else the last one that changed any file
    of the generator, else None.
    """

    @cache  # the commits are read only when needed: most problems are already in the report
    def commits() -> list[Commit]:
        return list(commit_log.person_commits(repo, to, known))

    def origin(path: str) -> tuple[str, str] | None:
        for paths in ((path,) if path else (), _ROOTS):
            for commit in commits():
                if _touches(commit, paths):
                    return str(commit.id), str(author_of(commit))
        return None

    return origin


def _touches(commit: Commit, paths: Iterable[str]) -> bool:
    return trees.differ(trees.parent_tree(commit), commit.tree, paths)


def author_of(commit: Commit) -> Person:
    plain = commit_message.signature(*commit_log.author_of(commit), commit_log.time_of(commit))
    return Person(plain.name, plain.email)


def caused_by_trailers(causes: Sequence[Commit]) -> list[tuple[str, str]]:
    """Return trailers for the newest of ``causes``, whose newest is first; in time's order."""
    named = reversed(causes[:_MOST_NAMED])
    return [("Caused-By", f"{commit.id} {author_of(commit)}") for commit in named]


def follow_author(causes: Sequence[Commit], now: datetime) -> pygit2.Signature:
    if not causes:
        return commit_message.generator_signature(now)
    people = list(dict.fromkeys(author_of(commit) for commit in reversed(causes)))
    names = ", ".join(dict.fromkeys(person.name for person in people))
    # one person's own address, so that `git log --author` finds the follow commit too
    email = people[0].email if len(people) == 1 else commit_log.GENERATOR_EMAIL
    return commit_message.signature(names, email, commit_log.time_of(causes[0]))


def operator(folder: str | None = None) -> Person:
    """Return who runs this program, as git knows this person, else by the login."""
    try:
        login = getpass.getuser()
    except (KeyError, OSError):  # a container's user has no passwd entry
        login = "unknown"

    def configured(variable: str, key: str) -> str:
        setting = git.Git(folder).config("--get", key, with_exceptions=False)
        return os.environ.get(variable) or str(setting)

    name = configured("GIT_AUTHOR_NAME", "user.name") or login
    email = configured("GIT_AUTHOR_EMAIL", "user.email") or f"{login}{_NO_ADDRESS}"
    return Person(name, email)
