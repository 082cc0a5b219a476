"""The state repo's history: commits with their trailers, and which commits the generator made.

Everything comes from commit messages and trailers, so plain git shows the same.
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

PROPOSAL = "Proposal"
"""The trailer of a commit that needs approval: the branch that it was proposed on."""

_WHY = "Why: "


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One commit of the state repo, with the content of its message."""

    commit: str
    time: datetime
    author: str
    summary: str
    trailers: dict[str, list[str]]
    why: str = ""

    def first(self, key: str) -> str:
        """Return the first value of a trailer, or an empty text."""
        return next(iter(self.trailers.get(key, ())), "")

    @property
    def by_generator(self) -> bool:
        """Whether the generator made the commit, so that its files match its ledger.

        A proposal does not count: a person merges it, maybe onto other changes, so it is read
        again.
        """
        return "Render-Version" in self.trailers and PROPOSAL not in self.trailers


def trailers_of(message: str) -> dict[str, list[str]]:
    """Return the trailers of a commit message: the lines ``Key: value`` of its last paragraph."""
    trailers: dict[str, list[str]] = {}
    paragraph = message.rstrip("\n").rsplit("\n\n", 1)
    if len(paragraph) < 2:
        return trailers
    for line in paragraph[1].split("\n"):
        key, colon, value = line.partition(": ")
        if not colon or " " in key:
            return {}
        trailers.setdefault(key, []).append(value)
    return trailers


def entry_of(commit: Commit) -> LogEntry:
    """Return the log entry of a commit."""
    return LogEntry(
        commit=str(commit.id),
        time=datetime.fromtimestamp(commit.commit_time, tz=timezone.utc),
        author=commit.author.name,
        summary=commit.message.split("\n", 1)[0],
        trailers=trailers_of(commit.message),
        why=_why(commit.message),
    )


def _why(message: str) -> str:
    """Return the sentence after ``Why:`` in a generator's commit."""
    lines = (line for line in message.split("\n") if line.startswith(_WHY))
    return next(lines, "").removeprefix(_WHY)


def commits(
    repo: Repository, tip: str | Oid, until: str | Oid | None = None
) -> Iterator[tuple[Commit, LogEntry]]:
    """Yield the commits that ``tip`` includes and ``until`` does not, newest first."""
    walker = repo.walk(commit_of(repo, tip).id, SortMode.TOPOLOGICAL)
    if until is not None:
        walker.hide(commit_of(repo, until).id)
    return ((commit, entry_of(commit)) for commit in walker)


def walk(repo: Repository, tip: str | Oid, until: str | Oid | None = None) -> Iterator[LogEntry]:
    """Yield the log entries of :func:`commits`."""
    return (entry for _, entry in commits(repo, tip, until))


def person_commits(
    repo: Repository, tip: str | Oid, until: str | Oid | None = None
) -> Iterator[Commit]:
    """Yield the commits of :func:`commits` that people made."""
    return (commit for commit, entry in commits(repo, tip, until) if not entry.by_generator)


def first_parents(repo: Repository, tip: str | Oid) -> Iterator[Commit]:
    """Yield a commit, its first parent, that one's first parent and so on."""
    commit = commit_of(repo, tip)
    yield commit
    while commit.parents:
        commit = commit.parents[0]
        yield commit


_OUTCOMES: dict[str, Literal["changed", "unchanged", "refused"]] = {
    "Operation-Id": "changed",
    "Unchanged-Operation-Id": "unchanged",
    "Refused-Operation-Id": "refused",
}


@dataclass(frozen=True, slots=True)
class RecordedOutcome:
    """The commit that records a demand, and the demand's outcome."""

    commit: str
    outcome: Literal["changed", "unchanged", "refused"]


def operations_since(repo: Repository, tip: Oid, base: str) -> dict[str, RecordedOutcome]:
    """Return operation id → outcome of every demand that commits after ``base`` record.

    Reads all of history if ``base`` is not known here (a remote that was made again).
    """
    try:
        known = bool(base) and repo.descendant_of(tip, base)
    except (pygit2.GitError, KeyError, ValueError):
        known = False
    until = base if known else None
    if str(tip) == base:
        return {}
    outcomes = {}
    for entry in walk(repo, tip, until):
        for key, outcome in _OUTCOMES.items():
            for operation in entry.trailers.get(key, ()):
                outcomes[operation] = RecordedOutcome(entry.commit, outcome)
    return outcomes


def last_generator_commit(repo: Repository, tip: Oid) -> Oid | None:
    """Return the newest commit of the generator along the first parents, or None."""
    entries = (entry_of(commit) for commit in first_parents(repo, tip))
    return next((Oid(hex=entry.commit) for entry in entries if entry.by_generator), None)
