"""Git trees: looking up a path, reading files, comparing trees."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from itertools import islice

import pygit2
from pygit2 import Blob, Commit, Object, Oid, Repository, Tree
from pygit2.enums import ConfigLevel, DeltaStatus, FileMode, SortMode

from demandops.base.errors import StateRepoError
from demandops.base.quoting import quoted
from demandops.base.runtime import log

# Sync the files that libgit2 writes, so that a commit is on the disk before anybody learns of it.
pygit2.option(pygit2.enums.Option.ENABLE_FSYNC_GITDIR, 1)
# By default libgit2 does not cache trees over 4 KiB and parses them at every look-up.
pygit2.option(pygit2.enums.Option.SET_CACHE_OBJECT_LIMIT, pygit2.enums.ObjectType.TREE, 1 << 20)

if shutil.which("git") is None:
    raise ImportError("git is not installed")

# One wrong line in a person's settings for git stops git and libgit2 alike. They go on without.
for _read in (
    pygit2.Config.get_global_config,
    pygit2.Config.get_xdg_config,
    lambda: pygit2.Config(os.environ.get("GIT_CONFIG_GLOBAL", os.devnull)),
):
    try:
        _read()
    except OSError:
        continue  # there is no such file
    except pygit2.GitError as _error:
        for _level in (ConfigLevel.GLOBAL, ConfigLevel.XDG):
            pygit2.settings.search_path[_level] = ""
        os.environ["GIT_CONFIG_GLOBAL"] = os.devnull
        log.warning(
            "your settings for git are left out, also those for credentials: %s; mend that line",
            _error,
        )
        break

MAX_DEPTH = 64  # how many folders deep a file may be; deeper folders are not read


def commit_of(repo: Repository, commit: str | Oid) -> Commit:
    # An id as text may come from a trailer or the journal, so it may be any text. What people write
    # is read by `commit_log.resolve`.
    try:
        if isinstance(commit, str) and not re.fullmatch("[0-9a-f]{40}", commit):
            raise StateRepoError(f"{quoted(commit)} is no commit's id of 40 hexadecimal digits")
        return repo[commit].peel(Commit)
    except pygit2.InvalidError as error:
        raise StateRepoError(
            f"commit {error}; set the branch back to the commit before it"
        ) from None
    except (KeyError, ValueError, pygit2.GitError):
        raise StateRepoError(
            f"the commit {commit} cannot be read; check the disk of the state repo and of its "
            "clone, then try again"
        ) from None


def place_of(repo: Repository, wanted: Oid) -> str | None:
    """Return where the newest commits have an object, which itself may be missing."""
    seen = set[Oid]()

    def path_in(tree: Tree, prefix: str) -> str | None:
        seen.add(tree.id)
        for child in tree:
            path = prefix + printable(child.raw_name or b"")
            if child.id == wanted:
                return path
            if isinstance(child, Tree) and child.id not in seen and path.count("/") < MAX_DEPTH:
                inner = path_in(child, f"{path}/")
                if inner is not None:
                    return inner
        return None

    try:
        walker = repo.walk(None, SortMode.TIME)
        for name in repo.references:
            walker.push(repo.references[name].peel(Commit).id)
        for commit in islice(walker, 10_000):  # each reads folders, and a history may be long
            path = "the top folder" if commit.tree_id == wanted else path_in(commit.tree, "")
            if path is not None:
                return f"{path} of commit {str(commit.id)[:10]}"
    except (KeyError, ValueError, pygit2.GitError):  # more is damaged
        pass
    return None


def includes(repo: Repository, commit: str | Oid, other: str | Oid) -> bool:
    """Return whether ``commit`` is ``other`` or descends from it, as far as known here."""
    try:
        return commit == other or repo.descendant_of(commit, other)
    except (pygit2.GitError, KeyError, ValueError):
        return False


def parent_tree(commit: Commit) -> Tree | None:
    return commit.parents[0].tree if commit.parents else None


def entry(tree: Tree | None, path: str) -> Object | None:
    try:
        return tree[path] if tree is not None else None
    except KeyError:
        return None


def entry_id(tree: Tree | None, path: str) -> Oid | None:
    child = entry(tree, path)
    return child.id if child is not None else None


def read_text(tree: Tree | None, path: str) -> str | None:
    blob = entry(tree, path)
    return text_of(blob) if isinstance(blob, Blob) else None


def text_of(blob: Object) -> str:
    # a person's file in another encoding must give a fault of its content, not an exception
    return blob.data.decode("utf-8", "replace") if isinstance(blob, Blob) else ""


def entries(tree: Tree, roots: Iterable[str]) -> Iterator[tuple[str, Object]]:
    """Yield (path, object) of each file, link or submodule at or below the paths ``roots``.

    The order is Git's. A folder that is deeper than :data:`MAX_DEPTH` is yielded like a file. In a
    name, a byte that is not UTF-8 is shown as ``\\xff``.
    """
    left = [(root, entry(tree, root)) for root in roots][::-1]
    while left:
        path, child = left.pop()
        if isinstance(child, Tree) and path.count("/") < MAX_DEPTH:
            inner = [(f"{path}/{printable(each.raw_name or b'')}", each) for each in child]
            left += inner[::-1]
        elif child is not None:
            yield path, child


def printable(name: bytes) -> str:
    return name.decode("utf-8", "backslashreplace")


def blobs(tree: Tree, roots: Iterable[str]) -> Iterator[tuple[str, Blob]]:
    for path, child in entries(tree, roots):
        if isinstance(child, Blob):
            yield path, child


def is_file(child: Object) -> bool:
    return isinstance(child, Blob) and child.filemode != FileMode.LINK


def texts(tree: Tree, roots: Iterable[str]) -> dict[str, str]:
    # the text of a link is the path that it points to
    return {path: text_of(blob) for path, blob in blobs(tree, roots)}


def differ(one: Tree | None, other: Tree | None, paths: Iterable[str]) -> bool:
    return any(entry_id(one, path) != entry_id(other, path) for path in paths)


def differences(
    before: Tree | None, after: Tree | None, roots: Iterable[str] = ()
) -> Iterator[tuple[str, Oid | None]]:
    """Yield the path of each file that differs, and its id in ``after``, None if it was removed.

    Without ``roots``, all files are compared. A file whose mode alone changed, and a file deeper
    than :data:`MAX_DEPTH`, is left out. Equal subtrees are not read.
    """
    if before is not None and after is not None:
        diff = before.diff_to_tree(after)
    elif (tree := after if before is None else before) is not None:
        diff = tree.diff_to_tree(swap=before is None)
    else:
        return
    below, changed = tuple(f"{root}/" for root in roots), dict[str, Oid | None]()
    for delta in diff.deltas:
        is_gone = delta.status == DeltaStatus.DELETED
        path = printable((delta.old_file if is_gone else delta.new_file).raw_path)
        if path.count("/") > MAX_DEPTH or (below and not f"{path}/".startswith(below)):
            continue
        # a file that became a link is one that is gone and one that is new
        if is_gone:
            changed.setdefault(path, None)
        elif delta.old_file.id != delta.new_file.id:
            changed[path] = delta.new_file.id
    yield from changed.items()


def is_readme(path: str) -> bool:
    return path.rsplit("/", 1)[-1] == "README.md"
