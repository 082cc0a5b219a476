"""The history of one path: which commits added, changed and removed it.

Like ``git log -- <path>``. Compares tree entries by their ids, so it reads no file.
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import git
from pygit2 import Commit, Oid, Repository, Tree

from demandops import naming
from demandops.errors import InvalidInput
from demandops.ledger import claim_file
from demandops.render.gitops.paths import CLUSTERS_ROOT
from demandops.staterepo.git.tree import child, commit_of, differences_below, files_below, read_text
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
    """When a path was added last, changed since, and removed.

    ``newest`` are the commits that changed it since it was added, newest first; ``more`` is how
    many are left out. ``stopped`` is the commit that removed it, or None if it exists.
    """

    started: LogEntry | None
    newest: tuple[LogEntry, ...]
    more: int
    stopped: LogEntry | None


def changes_to(repo: Repository, tip: str | Oid, path: str) -> Iterator[PathChange]:
    """Yield the commits that changed a file or folder, newest first.

    At a merge it follows the parent that has the same file, like Git.
    """
    start = commit_of(repo, tip)
    order = count()  # so that no two entries of the heap are equal
    waiting = [(-start.commit_time, next(order), start, _entry(start, path))]
    seen = {start.id}
    while waiting:
        _, _, commit, current = heapq.heappop(waiting)
        parents = [(parent, _entry(parent, path)) for parent in commit.parents]
        same = next((pair for pair in parents if pair[1] == current), None)
        if same is not None:
            parents = [same]
        elif current is not None or parents:
            before = any(entry is not None for _, entry in parents)
            yield PathChange(entry_of(commit), before, current is not None)
        for parent, entry in parents:
            if parent.id not in seen:
                seen.add(parent.id)
                heapq.heappush(waiting, (-parent.commit_time, next(order), parent, entry))


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
    """Return the path of the last stopped release of a name, or None."""
    if not _NAME.fullmatch(name):
        return None
    return next(iter(_removed(repo, tip, f"{name}.yaml", "-1")), None)


def stopped_release_names(repo: Repository, tip: str | Oid) -> set[str]:
    """Return the names of all releases that were ever stopped; reads all of history."""
    removed = _removed(repo, tip, "*.yaml")
    return {path.rsplit("/", 1)[-1].removesuffix(".yaml") for path in removed}


def _removed(repo: Repository, tip: str | Oid, file: str, *more: str) -> list[str]:
    """Return the paths of releases that commits removed, newest first."""
    commit = str(commit_of(repo, tip).id)
    with git.Repo(repo.path) as opened:
        output = opened.git.log(
            *("--no-show-signature", "--diff-filter=D", "--no-renames", *more),
            *("--format=", "--name-only", "-z", commit),
            *("--", f":(glob){CLUSTERS_ROOT}/*/*/*/{file}"),
        )
    return [path for path in output.split("\0") if path]


def release_path(repo: Repository, tip: str | Oid, name: str) -> str | None:
    """Return the path of the release of a name in a commit, or None."""
    clusters = child(commit_of(repo, tip).tree, CLUSTERS_ROOT)
    files = files_below(clusters, f"{CLUSTERS_ROOT}/") if isinstance(clusters, Tree) else ()
    return next((path for path, _ in files if path.endswith(f"/{name}.yaml")), None)


def changes_node(repo: Repository, revision: str | Oid, node: str) -> bool:
    """Return whether a commit changed what runs on a node, or a claim that names it."""
    commit = commit_of(repo, revision)
    if not commit.parents:
        return False
    before, after = commit.parents[0].tree, commit.tree
    folder = naming.object_name("", node)
    for path, _ in differences_below(repo, before, after, CLUSTERS_ROOT):
        parts = path.split("/")
        if len(parts) == 5 and parts[3] == folder:
            return True
    changed = differences_below(repo, before, after, claim_file.LEDGER_ROOT)
    return any(
        _names(read_text(tree, path), path, node) for path, _ in changed for tree in (before, after)
    )


def _names(text: str | None, path: str, node: str) -> bool:
    """Return whether a claim's file names a node."""
    if text is None or claim_file.kind_of(path) is None:
        return False
    try:
        claim = claim_file.read(text, path)
    except InvalidInput:
        return False
    return claim.held.needs(node)


def _entry(commit: Commit, path: str) -> Oid | None:
    try:
        return commit.tree[path].id
    except KeyError:
        return None
