"""New Git objects, which are made in memory and written as one pack."""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from tempfile import mkdtemp

import pygit2
from gitdb.base import OStream
from gitdb.pack import PackEntity
from pygit2 import Oid, Repository, Signature, Tree
from pygit2.enums import FileMode, ObjectType

from demandops.repo.git.signing import Signer
from demandops.repo.git.tree import printable

# ---- a pack ----
#
# gitdb stores each object whole, not as a delta; Git's housekeeping makes deltas later. libgit2
# searches for deltas and reads the pack again: it takes 2.4 ms for the 20 objects of a demand and
# 141 ms for 1,000, gitdb 1.2 and 21 ms.

_LEVEL = 1  # of compression; a pack is short-lived, so speed counts more than size


def write_pack(folder: Path, objects: Sequence[tuple[Oid, ObjectType, bytes]]) -> Path:
    streams = [OStream(o.raw, _TYPES[kind], len(data), BytesIO(data)) for o, kind, data in objects]
    pack, index = BytesIO(), BytesIO()
    name, _ = PackEntity.write_pack(streams, pack.write, index.write, len(streams), _LEVEL)
    path = folder / f"pack-{name.hex()}.pack"
    for file, content in ((path, pack), (path.with_suffix(".idx"), index)):
        handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o444)  # as git's packs
        with open(handle, "wb") as opened:  # noqa: PTH123 - opens a file descriptor
            opened.write(content.getbuffer())
            opened.flush()
            os.fsync(handle)
    return path


# ---- new objects: kept in memory, then written to the disk as one pack ----
#
# A pack needs a few syncs for all commits of a batch. Loose objects would need some syncs each.
# Every new object that the commits need goes into the pack, even if the repository already has a
# loose copy of the object. The copy may not be on the disk yet, or git may soon prune it.

_TYPES = {ObjectType.COMMIT: b"commit", ObjectType.TREE: b"tree", ObjectType.BLOB: b"blob"}
UNFINISHED = "demandops-pack-"  # the prefix of the folders in which packs are built
_KEEP = b"\xfftOc"  # how an index begins, and our files that keep a pack

# An entry of a tree object: the mode, the name and the raw id.
_ENTRY = re.compile(rb"(([0-7]+) ([^\0]+)\0.{20})", re.DOTALL)
_ID = re.compile(rb"[0-7]+ [^\0]+\0(.{20})", re.DOTALL)
_FOLDER = b"40000"

# Name → raw entry of a folder. The name of a subfolder ends in a slash, so that sorting by name
# gives Git's order.
Entries = dict[bytes, bytes]
# How many folders to remember. The newest are kept, because demands often change these again. A
# remembered folder never becomes outdated, because an id always means the same content.
_REMEMBERED = 32


class NewObjects(pygit2.OdbBackend):
    """Objects that are in memory and not in a pack yet. The repository can read them."""

    def __init__(self, repo: Repository) -> None:
        super().__init__()
        # a strong reference would leak the repository and this object: Python does not know that
        # libgit2 refers to this object, so it could not free the cycle
        self._repo: Repository = weakref.proxy(repo)
        self._packs = Path(repo.path) / "objects" / "pack"
        self._unpacked: dict[Oid, tuple[ObjectType, bytes]] = {}
        self._folders: dict[Oid, Entries] = {}
        # the lowest priority, because most objects are read from the disk
        repo.odb.add_backend(self, 0)

    def add(self, kind: ObjectType, data: bytes) -> Oid:
        content = b"%s %d\0%s" % (_TYPES[kind], len(data), data)
        oid = Oid(raw=hashlib.sha1(content).digest())  # noqa: S324 - Git's object ids
        self._unpacked[oid] = (kind, data)
        return oid

    def add_commit(
        self,
        signer: Signer | None,
        people: tuple[Signature, Signature],  # author and committer
        text: str,
        tree: Oid,
        parents: Sequence[Oid],
    ) -> Oid:
        content = str(self._repo.create_commit_string(*people, text, tree, list(parents)))
        if signer is not None:
            head, end, message = content.partition("\n\n")
            # in a commit's header, a line that begins with a space continues the line before
            signature = signer.sign(content.encode()).replace("\n", "\n ")
            content = f"{head}\ngpgsig {signature}{end}{message}"
        return self.add(ObjectType.COMMIT, content.encode())

    def add_tree(self, base: Tree | None, files: Mapping[str, str | None]) -> Oid:
        """Add the tree ``base`` with the changes in ``files``, where None removes a file or folder.

        Only the folders above a changed file are written again.
        """
        tree = self._add_folder(base.id if base is not None else None, files)
        return tree or self.add(ObjectType.TREE, b"")

    def _add_folder(  # noqa: PLR0912
        self, base: Oid | None, files: Mapping[str, str | None]
    ) -> Oid | None:
        # None if the folder becomes empty, because Git has no empty folders
        if base is None:
            entries = Entries()
        elif base in self._folders:
            entries = self._folders.pop(base)
        else:
            raw = self._repo[base].peel(Tree).read_raw()
            entries = {
                name + b"/" if mode == _FOLDER else name: entry
                for entry, mode, name in _ENTRY.findall(raw)
            }
        below: dict[bytes, dict[str, str | None]] = {}
        here: dict[bytes, str | None] = {}
        for path, text in files.items():
            folder_name, _, inner_path = path.partition("/")
            raw_name = folder_name.encode()
            if raw_name not in entries and b"\\" in raw_name:
                # a backslash may stand for a byte that is not UTF-8
                names = (key.removesuffix(b"/") for key in entries)
                raw_name = next((n for n in names if printable(n) == folder_name), raw_name)
            if inner_path:
                below.setdefault(raw_name, {})[inner_path] = text
            else:
                here[raw_name] = text
        for name, inner in below.items():
            folder = name + b"/"
            kept = folder in entries and here.get(name, "") is not None
            old = Oid(raw=entries[folder][-20:]) if kept else None  # an entry ends with the raw id
            subtree = self._add_folder(old, inner)
            if subtree is not None:
                entries.pop(name, None)
                entries[folder] = b"40000 %s\0%s" % (name, subtree.raw)
            elif kept:
                del entries[folder]
        for name, text in here.items():  # after the folders, so that a file can replace a folder
            if text is not None:
                entries.pop(name + b"/", None)
                blob = self.add(ObjectType.BLOB, text.encode())
                entries[name] = b"100644 %s\0%s" % (name, blob.raw)
            elif not any(inner is not None for inner in below.get(name, {}).values()):
                entries.pop(name, None)
                entries.pop(name + b"/", None)
        if not entries:
            return None
        oid = self.add(ObjectType.TREE, b"".join(map(entries.__getitem__, sorted(entries))))
        self._folders[oid] = entries
        if len(self._folders) > _REMEMBERED:
            del self._folders[next(iter(self._folders))]
        return oid

    def forget(self) -> None:
        self._unpacked.clear()

    @contextmanager
    def packed(self, commit: Oid) -> Iterator[None]:
        """Write a synced pack with all new objects that a commit needs, then run the block.

        While the block runs, git's housekeeping does not remove the pack, although no reference
        leads to its commits yet.
        """
        unpacked = {oid.raw: oid for oid in self._unpacked}
        needed, queue = dict[Oid, None](), [commit]
        while queue:
            oid = queue.pop()
            if oid in needed or oid not in self._unpacked:
                continue
            needed[oid] = None
            kind, data = self._unpacked[oid]
            if kind is ObjectType.COMMIT:
                parsed = self._repo[oid].peel(pygit2.Commit)
                queue += [parsed.tree_id, *parsed.parent_ids]
            elif kind is ObjectType.TREE:
                queue += [unpacked[raw] for raw in _ID.findall(data) if raw in unpacked]
        if not needed:
            yield
            return
        objects = [(oid, *self._unpacked[oid]) for oid in needed]
        with _locked(self._packs, fcntl.LOCK_SH):
            folder = Path(mkdtemp(dir=self._packs.parents[1], prefix=UNFINISHED))
            keep: Path | None = None
            try:
                pack = write_pack(folder, objects)
                keep = self._packs / f"{pack.stem}.keep"
                # git removes no pack that has such a file; a link to what is synced costs no sync
                keep.unlink(missing_ok=True)
                try:
                    keep.hardlink_to(pack.with_suffix(".idx"))
                except OSError:  # the file system has no hard links, or the disk no room
                    # never into a file that exists: it may be a link to the index of a pack
                    unplaced = pack.with_suffix(".keep")
                    unplaced.write_bytes(_KEEP)
                    unplaced.replace(keep)
                # the pack comes first, because git removes an index without a pack
                for file in (pack, pack.with_suffix(".idx")):
                    file.replace(self._packs / file.name)
                sync_folder(self._packs)
                for oid in needed:
                    del self._unpacked[oid]
                yield
            finally:
                # What stays is removed at the next start. For the folder itself, rmtree raises some
                # errors nevertheless.
                with suppress(OSError):
                    if keep is not None:
                        keep.unlink(missing_ok=True)
                with suppress(OSError):
                    shutil.rmtree(folder, ignore_errors=True)

    def read_again(self, commit: Oid, since: str) -> None:
        """Hold the objects that ``commit`` has and ``since`` lacks in memory, as if they were new.

        If ``since`` is unknown here, these are all objects of ``commit``. They are on the disk, but
        an earlier sync of them may have failed; reading one checks it.
        """
        walker = self._repo.walk(commit)
        queue, seen = list[Oid](), set[Oid]()
        if since and since in self._repo:
            walker.hide(since)
            queue.append(self._repo[since].peel(pygit2.Commit).tree_id)
            while queue:
                seen.add(oid := queue.pop())
                queue += _ids_in(self._repo, oid)
        for each in walker:
            queue += [each.id, each.tree_id]
        while queue:
            if (oid := queue.pop()) in seen:
                continue
            seen.add(oid)
            kind, data = self._repo.odb.read(oid)
            self._unpacked[oid] = (ObjectType(kind), data)
            queue += _ids_in(self._repo, oid)

    def clean(self) -> None:
        # of what killed processes left, unless another process writes a pack now
        with suppress(OSError), _locked(self._packs, fcntl.LOCK_EX | fcntl.LOCK_NB):
            for folder in Path(self._repo.path).glob(f"{UNFINISHED}*"):
                shutil.rmtree(folder, ignore_errors=True)
            for keep in self._packs.glob("*.keep"):
                with keep.open("rb") as file:  # a person may have made one too
                    is_ours = file.read(len(_KEEP)) == _KEEP
                if is_ours:
                    keep.unlink()

    # ---- called by libgit2 ----

    def __iter__(self) -> Iterator[Oid]:
        return iter(self._unpacked)

    def exists_cb(self, oid: Oid) -> bool:
        return oid in self._unpacked

    def read_cb(self, oid: Oid) -> tuple[int, bytes]:
        return self._unpacked[oid]

    def read_header_cb(self, oid: Oid) -> tuple[int, int]:
        kind, data = self._unpacked[oid]
        return kind, len(data)

    def read_prefix_cb(self, oid: Oid) -> tuple[int, bytes, Oid]:
        kind, data = self._unpacked[oid]  # a shortened id finds nothing
        return kind, data, oid

    def refresh_cb(self) -> None:
        pass  # memory is always current


def _ids_in(repo: Repository, oid: Oid) -> list[Oid]:
    # of a tree's files and folders, without submodules, whose commits are elsewhere
    tree = repo[oid]
    entries = tree if isinstance(tree, Tree) else ()
    return [child.id for child in entries if child.filemode != FileMode.COMMIT]


@contextmanager
def _locked(folder: Path, operation: int) -> Iterator[None]:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, operation)
        yield
    finally:
        os.close(handle)


def sync_folder(folder: Path) -> None:
    # without this, a power loss may take the names of new files, though not their content
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
