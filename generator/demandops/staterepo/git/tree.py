"""Git trees: reading a commit's files, comparing trees, writing only the changed parts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pygit2
from pygit2 import Commit, Oid, Repository, Tree
from pygit2.enums import FileMode

from demandops.errors import StateRepoError

pygit2.option(pygit2.enums.Option.ENABLE_FSYNC_GITDIR, 1)  # a reported commit is on the disk
# By default libgit2 does not cache trees over 4 KiB and parses them at every look-up.
pygit2.option(pygit2.enums.Option.SET_CACHE_OBJECT_LIMIT, pygit2.enums.ObjectType.TREE, 1 << 20)


def commit_of(repo: Repository, revision: str | Oid) -> Commit:
    """Return the commit of a revision, in any form that Git knows.

    Raises:
        StateRepoError: there is no such commit.
    """
    try:
        found = repo[revision] if isinstance(revision, Oid) else repo.revparse_single(revision)
        return found.peel(Commit)
    except (KeyError, ValueError, pygit2.GitError):
        raise StateRepoError(
            f"'{revision}' is not a commit of the state repo; `demandops log` lists them"
        ) from None


def read_text(tree: Tree, path: str) -> str | None:
    """Return the text of a file, or None. Invalid UTF-8 is replaced, so that it is visible."""
    try:
        entry = tree[path]
    except KeyError:
        return None
    return entry.data.decode("utf-8", "replace") if isinstance(entry, pygit2.Blob) else None


def blob_id(tree: Tree, path: str) -> Oid | None:
    """Return the id of a file, or None."""
    entry = child(tree, path)
    return entry.id if isinstance(entry, pygit2.Blob) else None


def entry_id(tree: Tree, name: str) -> Oid | None:
    """Return the id of a file or folder, or None."""
    entry = child(tree, name)
    return entry.id if entry is not None else None


def child(tree: Tree, name: str) -> pygit2.Object | None:
    """Return the entry ``name`` of a tree, or None."""
    try:
        return tree[name]
    except KeyError:
        return None


def files_below(tree: Tree, prefix: str = "") -> Iterator[tuple[str, Oid]]:
    """Yield (path, blob id) of every file below a tree, in Git's order."""
    for entry in tree:
        path = f"{prefix}{entry.name}"
        if isinstance(entry, Tree):
            yield from files_below(entry, f"{path}/")
        elif isinstance(entry, pygit2.Blob):
            yield path, entry.id


def texts(tree: Tree, roots: tuple[str, ...]) -> dict[str, str]:
    """Return path → text of every file below the top-level entries ``roots``."""
    contents: dict[str, str] = {}
    for root in roots:
        if root not in tree:
            continue
        entry = tree[root]
        if isinstance(entry, Tree):
            for path, _ in files_below(entry, f"{root}/"):
                contents[path] = read_text(tree, path) or ""
        elif isinstance(entry, pygit2.Blob):
            contents[root] = entry.data.decode("utf-8", "replace")
    return contents


def differences(
    repo: Repository, before: Tree | None, after: Tree | None, prefix: str
) -> Iterator[tuple[str, Oid | None]]:
    """Yield (path, new blob id or None) of each file that differs; skip equal subtrees."""
    if before is not None and after is not None and before.id == after.id:
        return
    old = {str(entry.name): entry for entry in before} if before is not None else {}
    new = {str(entry.name): entry for entry in after} if after is not None else {}
    for name in sorted({*old, *new}):
        left, right = old.get(name), new.get(name)
        if left is not None and right is not None and left.id == right.id:
            continue
        path = f"{prefix}{name}"
        if isinstance(left, Tree) or isinstance(right, Tree):
            yield from differences(
                repo,
                left if isinstance(left, Tree) else None,
                right if isinstance(right, Tree) else None,
                f"{path}/",
            )
        if isinstance(right, pygit2.Blob):
            yield path, right.id
        elif isinstance(left, pygit2.Blob):
            yield path, None


def differences_below(
    repo: Repository, before: Tree, after: Tree, root: str
) -> Iterator[tuple[str, Oid | None]]:
    """Yield (path, new blob id or None) of each file that differs at or below a top-level entry."""
    old, new = child(before, root), child(after, root)
    if isinstance(new, pygit2.Blob) and (old is None or old.id != new.id):
        yield root, new.id
    elif isinstance(old, pygit2.Blob) and not isinstance(new, pygit2.Blob):
        yield root, None
    sides = [entry if isinstance(entry, Tree) else None for entry in (old, new)]
    yield from differences(repo, sides[0], sides[1], f"{root}/")


def is_readme(path: str) -> bool:
    """Return whether this is a README, which people may put beside generated files."""
    return path.rsplit("/", 1)[-1] == "README.md"


def write(repo: Repository, base: Tree | None, files: Mapping[str, str | None]) -> Oid:
    """Write ``base`` with ``files`` changed (``None`` removes) and return the new tree's id.

    Only the folders above a changed file are written again. A folder that becomes empty is
    removed, because Git has no empty folders.
    """
    return _builder(repo, base, files).write()


def _writes(files: Mapping[str, str | None]) -> bool:
    return any(text is not None for text in files.values())


def _builder(
    repo: Repository, base: Tree | None, files: Mapping[str, str | None]
) -> pygit2.TreeBuilder:
    builder = repo.TreeBuilder(base) if base is not None else repo.TreeBuilder()
    below: dict[str, dict[str, str | None]] = {}
    here: dict[str, str | None] = {}
    for path, text in files.items():
        name, _, rest = path.partition("/")
        if rest:
            below.setdefault(name, {})[rest] = text
        else:
            here[name] = text
    for name, inner in below.items():
        entry = builder.get(name)
        replaced = name in here and here[name] is None
        folder = entry if isinstance(entry, Tree) and not replaced else None
        subtree = _builder(repo, folder, inner)
        if len(subtree):
            builder.insert(name, subtree.write(), FileMode.TREE)
        elif folder is not None:
            builder.remove(name)
    for name, text in here.items():  # last, so that a file can replace a folder
        if text is not None:
            builder.insert(name, repo.create_blob(text.encode()), FileMode.BLOB)
        elif builder.get(name) is not None and not _writes(below.get(name, {})):
            builder.remove(name)
    return builder
