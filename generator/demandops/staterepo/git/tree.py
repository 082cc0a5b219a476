"""Git trees: read files of a commit, write a changed tree at the cost of what changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pygit2
from pygit2 import Commit, Oid, Repository, Tree
from pygit2.enums import FileMode

from demandops.errors import StateRepoError

pygit2.option(pygit2.enums.Option.ENABLE_FSYNC_GITDIR, 1)  # a commit told of is on the disk
# By default libgit2 forgets trees over 4 KiB at once and parses them again at every look-up.
pygit2.option(pygit2.enums.Option.SET_CACHE_OBJECT_LIMIT, pygit2.enums.ObjectType.TREE, 1 << 20)


def commit_of(repo: Repository, revision: str | Oid) -> Commit:
    """Return a commit by any name that Git knows.

    Raises:
        StateRepoError: where there is none.
    """
    try:
        found = repo[revision] if isinstance(revision, Oid) else repo.revparse_single(revision)
        return found.peel(Commit)
    except (KeyError, ValueError, pygit2.GitError):
        raise StateRepoError(
            f"'{revision}' is no commit of the state repo; `demandops log` lists them"
        ) from None


def read_text(tree: Tree, path: str) -> str | None:
    """Return the text of a file, or nothing where there is none. Bytes that are no UTF-8 show."""
    try:
        entry = tree[path]
    except KeyError:
        return None
    return entry.data.decode("utf-8", "replace") if isinstance(entry, pygit2.Blob) else None


def blob_id(tree: Tree, path: str) -> Oid | None:
    """Return the id of a file, or nothing where there is none."""
    entry = child(tree, path)
    return entry.id if isinstance(entry, pygit2.Blob) else None


def entry_id(tree: Tree, name: str) -> Oid | None:
    """Return the id of an entry of a tree, a file or a folder, or nothing."""
    entry = child(tree, name)
    return entry.id if entry is not None else None


def child(tree: Tree, name: str) -> pygit2.Object | None:
    """Return the entry ``name`` of a tree, or nothing."""
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
    found: dict[str, str] = {}
    for root in roots:
        if root not in tree:
            continue
        entry = tree[root]
        if isinstance(entry, Tree):
            for path, _ in files_below(entry, f"{root}/"):
                found[path] = read_text(tree, path) or ""
        elif isinstance(entry, pygit2.Blob):
            found[root] = entry.data.decode("utf-8", "replace")
    return found


def differences(
    repo: Repository, before: Tree | None, after: Tree | None, prefix: str
) -> Iterator[tuple[str, Oid | None]]:
    """Yield (path, blob id or nothing) of each file that differs; equal subtrees are not opened."""
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
    """Yield (path, blob id or nothing) of each file that differs at or below a top-level entry."""
    old, new = child(before, root), child(after, root)
    if isinstance(new, pygit2.Blob) and (old is None or old.id != new.id):
        yield root, new.id
    elif isinstance(old, pygit2.Blob) and not isinstance(new, pygit2.Blob):
        yield root, None
    sides = [entry if isinstance(entry, Tree) else None for entry in (old, new)]
    yield from differences(repo, sides[0], sides[1], f"{root}/")


def is_readme(path: str) -> bool:
    """Tell what people may put beside generated files: a README is no manifest."""
    return path.rsplit("/", 1)[-1] == "README.md"


def write(repo: Repository, base: Tree | None, files: Mapping[str, str | None]) -> Oid:
    """Write ``base`` with ``files`` changed (``None`` removes) and return the new tree's id.

    Only the folders on the way to a changed file are written again; a folder that becomes empty
    goes, as Git knows no empty ones.
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
    for name, text in here.items():  # last, so that a file may take the place of a folder
        if text is not None:
            builder.insert(name, repo.create_blob(text.encode()), FileMode.BLOB)
        elif builder.get(name) is not None and not _writes(below.get(name, {})):
            builder.remove(name)
    return builder
