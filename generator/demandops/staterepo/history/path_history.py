"""The history of one path: which commits added, changed and removed it.

``git log -- <path>`` finds them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import git
from pygit2 import Oid, Repository

from demandops.render.gitops.paths import CLUSTERS_ROOT
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.tree import commit_of
from demandops.staterepo.history.commit_log import LogEntry, entry_of

_NAME = re.compile(r"[a-z0-9]([a-z0-9-]*[a-z0-9])?")


@dataclass(frozen=True, slots=True)
class PathChange:
    """A commit that changed a path, and whether the path existed before and exists after it."""

    entry: LogEntry
    existed_before: bool
    exists_after: bool


@dataclass(frozen=True, slots=True)
class PathHistory:
    """The commits that last added a path, changed it since, and removed it.

    ``newest`` are the commits that changed it since it was added, newest first; ``more`` is how
    many are left out. ``stopped`` is the commit that removed it, or None if it exists.
    """

    started: LogEntry | None
    newest: tuple[LogEntry, ...]
    more: int
    stopped: LogEntry | None


def changes_to(
    repo: Repository, tip: str | Oid, path: str, until: str | None = None
) -> Iterator[PathChange]:
    """Yield the commits after ``until`` that changed a file or folder, newest first, like Git."""
    for revision in _git_log(repo, tip, until, "--format=%H", f":(literal){path}"):
        commit = commit_of(repo, revision)
        before = any(trees.entry(parent.tree, path) is not None for parent in commit.parents)
        yield PathChange(entry_of(commit), before, trees.entry(commit.tree, path) is not None)


def history_of(repo: Repository, tip: str | Oid, path: str, most: int) -> PathHistory:
    """Return the history of a path up to ``tip``, with at most ``most`` of its changes."""
    started = stopped = None
    changes: list[LogEntry] = []
    more = 0
    for change in changes_to(repo, tip, path):
        if not change.exists_after:
            stopped = change.entry
        elif not change.existed_before:
            started = change.entry
            break
        elif len(changes) < most:
            changes.append(change.entry)
        else:
            more += 1
    return PathHistory(started, tuple(changes), more, stopped)


def stopped_release_path(repo: Repository, tip: str | Oid, name: str) -> str | None:
    """Return the path of the last stopped release with this name, or None."""
    if not _NAME.fullmatch(name):
        return None
    return next(iter(_removed(repo, tip, f"{name}.yaml", "-1")), None)


def stopped_release_names(repo: Repository, tip: str | Oid) -> set[str]:
    """Return the names of all releases that ever stopped; reads the whole history."""
    removed = _removed(repo, tip, "*.yaml")
    return {path.rsplit("/", 1)[-1].removesuffix(".yaml") for path in removed}


def _removed(repo: Repository, tip: str | Oid, file: str, *more: str) -> list[str]:
    """Return the paths of releases that commits removed, newest first."""
    options = ("--diff-filter=D", "--no-renames", *more, "--format=", "--name-only")
    return _git_log(repo, tip, None, *options, f":(glob){CLUSTERS_ROOT}/*/*/*/{file}")


def _git_log(repo: Repository, tip: str | Oid, until: str | None, *query: str) -> list[str]:
    """Return the output of ``git log`` for the path that ``query`` ends with."""
    *options, path = query
    commits = [str(commit_of(repo, tip).id), *([f"^{until}"] if until else [])]
    with git.Repo(repo.path) as opened:
        output = opened.git.log("--no-show-signature", "-z", *options, *commits, "--", path)
    return [found for found in output.split("\0") if found]


def release_path(repo: Repository, tip: str | Oid, name: str) -> str | None:
    """Return the path of the release with this name in a commit, or None."""
    files = trees.blobs(commit_of(repo, tip).tree, (CLUSTERS_ROOT,))
    return next((path for path, _ in files if path.endswith(f"/{name}.yaml")), None)
