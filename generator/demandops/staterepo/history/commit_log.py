"""Reading the state repo's history: what the log says, and which commits are the generator's.

Everything is in commit messages and trailers, so plain git says the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Literal

import pygit2
from pygit2 import Commit, Oid, Repository
from pygit2.enums import SortMode

from demandops.staterepo.git.tree import commit_of
from demandops.staterepo.history.commit_message import PROPOSAL

_WHY = "Why: "


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One commit of the state repo, as its message tells it."""

    commit: str
    time: datetime
    author: str
    summary: str
    trailers: dict[str, list[str]]
    why: str = ""

    def first(self, key: str) -> str:
        """Return the first value of a trailer, or nothing."""
        return next(iter(self.trailers.get(key, ())), "")

    @property
    def by_generator(self) -> bool:
        """Tell whether the generator made the commit, so that its files fit its books."""
        return "Render-Version" in self.trailers and PROPOSAL not in self.trailers


def trailers_of(message: str) -> dict[str, list[str]]:
    """Return the trailers of a commit message: the lines ``Key: value`` of its last paragraph."""
    found: dict[str, list[str]] = {}
    paragraph = message.rstrip("\n").rsplit("\n\n", 1)
    if len(paragraph) < 2:
        return found
    for line in paragraph[1].split("\n"):
        key, colon, value = line.partition(": ")
        if not colon or " " in key:
            return {}
        found.setdefault(key, []).append(value)
    return found


def entry_of(commit: Commit) -> LogEntry:
    """Return what a commit says."""
    return LogEntry(
        commit=str(commit.id),
        time=datetime.fromtimestamp(commit.commit_time, tz=timezone.utc),
        author=commit.author.name,
        summary=commit.message.split("\n", 1)[0],
        trailers=trailers_of(commit.message),
        why=_why(commit.message),
    )


def _why(message: str) -> str:
    """Return the sentence in which a commit of the generator says why it was made."""
    lines = (line for line in message.split("\n") if line.startswith(_WHY))
    return next(lines, "").removeprefix(_WHY)


def walk(repo: Repository, tip: str | Oid, until: str | Oid | None = None) -> Iterator[LogEntry]:
    """Yield the commits from ``tip`` back, newest first, without those that ``until`` has too."""
    walker = repo.walk(commit_of(repo, tip).id, SortMode.TOPOLOGICAL)
    if until is not None:
        walker.hide(commit_of(repo, until).id)
    for commit in walker:
        yield entry_of(commit)


_OUTCOMES: dict[str, Literal["changed", "unchanged", "refused"]] = {
    "Operation-Id": "changed",
    "Unchanged-Operation-Id": "unchanged",
    "Refused-Operation-Id": "refused",
}


@dataclass(frozen=True, slots=True)
class RecordedOutcome:
    """Where a demand is found in history, and what came of it."""

    commit: str
    outcome: Literal["changed", "unchanged", "refused"]


def operations_since(repo: Repository, tip: Oid, base: str) -> dict[str, RecordedOutcome]:
    """Return operation id → arrival of every demand that was settled after ``base``.

    Where ``base`` is not known here (a remote that was laid anew), all of history is read.
    """
    try:
        known = bool(base) and repo.descendant_of(tip, base)
    except (pygit2.GitError, KeyError, ValueError):
        known = False
    until = base if known else None
    if str(tip) == base:
        return {}
    found = {}
    for entry in walk(repo, tip, until):
        for key, outcome in _OUTCOMES.items():
            for operation in entry.trailers.get(key, ()):
                found[operation] = RecordedOutcome(entry.commit, outcome)
    return found


def last_generator_commit(repo: Repository, tip: Oid) -> Oid | None:
    """Return the newest commit of the generator on the first-parent line, or nothing."""
    commit: Commit | None = commit_of(repo, tip)
    while commit is not None:
        if entry_of(commit).by_generator:
            return commit.id
        commit = commit.parents[0] if commit.parents else None
    return None
