"""New objects of a state repo: kept in memory, then written to the disk as one pack.

A pack needs a few syncs for all commits of a batch. Loose objects would need some syncs each. Every
new object that the commits need goes into the pack, even if the repository already has a loose copy
of the object. The copy may not be on the disk yet, or git may soon prune it.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import mkdtemp

import pygit2
from pygit2 import Oid, Repository, Tree
from pygit2.enums import ObjectType

from demandops.staterepo.git.pack_file import write_pack

_TYPES = {ObjectType.COMMIT: b"commit", ObjectType.TREE: b"tree", ObjectType.BLOB: b"blob"}
_LAST = 0
"""The priority of this source: the lowest, because most objects are read from other sources."""

UNFINISHED = "demandops-pack-"
"""The prefix of the folders in which packs are built."""
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK)
"""The errors raised if a file system has no hard links, or a file has too many."""
_INDEX = b"\xfftOc"
"""The first bytes of the index of a pack."""

_ENTRY = re.compile(rb"(([0-7]+) ([^\0]+)\0.{20})", re.DOTALL)
"""An entry of a tree object: the mode, the name and the raw id."""
_ID = re.compile(rb"[0-7]+ [^\0]+\0(.{20})", re.DOTALL)
_FOLDER = b"40000"

Entries = dict[bytes, bytes]
"""Name → raw entry, for each entry of a folder.

The name of a subfolder ends in a slash, so that sorting by name gives Git's order.
"""
_REMEMBERED = 32
"""How many folders to remember.

The newest folders are kept, because demands often change these again. A remembered folder never
becomes outdated, because an id always means the same content.
"""


class NewObjects(pygit2.OdbBackend):
    """Objects that are in memory and not in a pack yet. The repository can read them."""

    def __init__(self, repo: Repository) -> None:
        super().__init__()
        # a strong reference would leak the repository and this object: Python does not know that
        # libgit2 refers to this object, so it could not free the cycle
        self._repo = weakref.ref(repo)
        self._known: dict[Oid, tuple[ObjectType, bytes]] = {}
        self._folders: dict[Oid, Entries] = {}
        repo.odb.add_backend(self, _LAST)

    @property
    def repo(self) -> Repository:
        """The repository.

        The writer must keep a reference to the repository, because this object has only a weak one.
        """
        repo = self._repo()
        assert repo is not None  # noqa: S101 - its writer has a strong reference
        return repo

    def add(self, kind: ObjectType, data: bytes) -> Oid:
        """Keep an object in memory until it is packed, and return its id."""
        header = b"%s %d\0" % (_TYPES[kind], len(data))
        oid = Oid(raw=_sha1(header + data))
        self._known[oid] = (kind, data)
        return oid

    def folder(self, oid: Oid) -> Entries:
        """Return the entries of a folder.

        The caller may change the entries, and pass them to :meth:`add_folder`.
        """
        known = self._folders.pop(oid, None)
        return _entries_of(self.repo[oid].peel(Tree).read_raw()) if known is None else known

    def add_folder(self, entries: Entries) -> Oid:
        """Keep a folder in memory until it is packed, and return its id.

        The caller must not change ``entries`` afterwards.
        """
        oid = self.add(ObjectType.TREE, b"".join(map(entries.__getitem__, sorted(entries))))
        self._folders[oid] = entries
        if len(self._folders) > _REMEMBERED:
            del self._folders[next(iter(self._folders))]
        return oid

    def forget(self) -> None:
        """Drop all objects that are not packed."""
        self._known.clear()

    @contextmanager
    def packed(self, commit: Oid) -> Iterator[None]:
        """Write a synced pack with all new objects that a commit needs, then run the block.

        While the block runs, git's housekeeping does not remove the pack, although no reference
        leads to its commits yet.
        """
        needed = self._needed_by(commit)
        if not needed:
            yield
            return
        with self._placed(lambda folder: self._build_pack(folder, needed)):
            for oid in needed:
                del self._known[oid]
            yield

    @contextmanager
    def packed_anew(self, commit: Oid, since: str) -> Iterator[None]:
        """Write a new synced pack with the objects that ``commit`` has and ``since`` lacks.

        If ``since`` is no commit of the repository, the pack has all objects of ``commit``.

        The repository has these objects, but they may not be durable, because an earlier sync may
        have failed. While the ``with`` block runs, git's housekeeping does not remove the pack.
        """
        without = f"^{since}\n" if since and since in self.repo else ""
        with self._placed(lambda folder: self._copy_to_pack(folder, f"{commit}\n{without}")):
            yield

    @contextmanager
    def _placed(self, build: Callable[[str], Path]) -> Iterator[None]:
        """Build a pack, move the pack and then its index into place, and run the ``with`` block.

        The pack comes first, because git removes an index without a pack. While the ``with`` block
        runs, a .keep file protects the pack. The .keep file begins like an index, so that
        :meth:`clean` recognizes the .keep file.
        """
        packs = self._packs
        with _locked(packs, fcntl.LOCK_SH), _folder_until_done(self.repo.path) as folder:
            built = build(folder)
            placed = packs / built.name
            keep = placed.with_suffix(".keep")
            keep.unlink(missing_ok=True)
            try:
                _mark(keep, built.with_suffix(".idx"))
                built.replace(placed)
                built.with_suffix(".idx").replace(placed.with_suffix(".idx"))
                sync_folder(packs)
                yield
            finally:
                with suppress(OSError):  # the next start removes the .keep file
                    keep.unlink(missing_ok=True)

    @property
    def _packs(self) -> Path:
        return Path(self.repo.path) / "objects" / "pack"

    def clean(self) -> None:
        """Remove files that killed processes left, unless another process writes a pack now."""
        with suppress(OSError), _locked(self._packs, fcntl.LOCK_EX | fcntl.LOCK_NB):
            for folder in Path(self.repo.path).glob(f"{UNFINISHED}*"):
                shutil.rmtree(folder, ignore_errors=True)
            for keep in self._packs.glob("*.keep"):
                with keep.open("rb") as file:
                    is_ours = file.read(len(_INDEX)) == _INDEX
                if is_ours:
                    keep.unlink()

    def _copy_to_pack(self, folder: str, revisions: str) -> Path:
        """Let git write a synced pack into ``folder``, with the objects that ``revisions`` selects.

        Return the pack's path. Git packs each object anew, so it reads and checks each object.
        """
        done = subprocess.run(
            ["git", "-c", "core.fsync=committed", "pack-objects", "--revs", "--quiet",
             "--no-reuse-delta", "--no-reuse-object", f"{folder}/pack"],
            cwd=self.repo.path,
            input=revisions,
            capture_output=True,
            text=True,
            check=False,
        )  # fmt: skip
        if done.returncode:
            raise pygit2.GitError(done.stderr.strip())
        return _pack_in(folder)

    def _build_pack(self, folder: str, needed: list[Oid]) -> Path:
        return write_pack(Path(folder), [(oid, *self._known[oid]) for oid in needed])

    def _needed_by(self, commit: Oid) -> list[Oid]:
        known = {oid.raw: oid for oid in self._known}
        needed, queue = dict[Oid, None](), [commit]
        while queue:
            oid = queue.pop()
            if oid in needed or oid not in self._known:
                continue
            needed[oid] = None
            kind, data = self._known[oid]
            if kind is ObjectType.COMMIT:
                found = self.repo[oid].peel(pygit2.Commit)
                queue += [found.tree_id, *found.parent_ids]
            elif kind is ObjectType.TREE:
                queue += [known[raw] for raw in _ID.findall(data) if raw in known]
        return list(needed)

    # ---- called by libgit2 ----

    def __iter__(self) -> Iterator[Oid]:
        return iter(self._known)

    def exists_cb(self, oid: Oid) -> bool:
        """Return whether there is a new object with this id."""
        return oid in self._known

    def read_cb(self, oid: Oid) -> tuple[int, bytes]:
        """Return the type and the content of a new object."""
        return self._known[oid]

    def read_header_cb(self, oid: Oid) -> tuple[int, int]:
        """Return the type and the size of a new object."""
        kind, data = self._known[oid]
        return kind, len(data)

    def read_prefix_cb(self, oid: Oid) -> tuple[int, bytes, Oid]:
        """Return the type, content and id of a new object. A shortened id finds nothing."""
        kind, data = self._known[oid]
        return kind, data, oid

    def refresh_cb(self) -> None:
        """Do nothing: memory is always current."""


def _sha1(data: bytes | bytearray) -> bytes:
    return hashlib.sha1(data).digest()  # noqa: S324 - Git's object ids


def _entries_of(data: bytes) -> Entries:
    return {
        name + b"/" if mode == _FOLDER else name: entry
        for entry, mode, name in _ENTRY.findall(data)
    }


@contextmanager
def _folder_until_done(parent: str) -> Iterator[str]:
    """Yield a new folder, and remove the folder after the block.

    If the folder cannot be removed, the next start of the program removes it.
    """
    folder = mkdtemp(dir=parent, prefix=UNFINISHED)
    try:
        yield folder
    finally:
        with suppress(OSError):  # for the folder itself, rmtree raises some errors nevertheless
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _locked(folder: Path, how: int) -> Iterator[None]:
    """Lock a folder while the block runs; ``how`` is the operation of ``flock``.

    Several writers of packs may share the lock.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, how)
        yield
    finally:
        os.close(handle)


def _pack_in(folder: str) -> Path:
    """Return the path of the only pack in a folder.

    Raises OSError if the folder cannot be read. :meth:`Path.glob` would hide this error.
    """
    (pack,) = [path for path in Path(folder).iterdir() if path.suffix == ".pack"]
    return pack


def _mark(keep: Path, index: Path) -> None:
    """Make the .keep file of a pack: a hard link to the pack's index, which is synced already.

    On a file system without hard links, write and sync a new file, then move it to ``keep``.
    """
    try:
        keep.hardlink_to(index)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        made = index.with_suffix(".keep")
        with made.open("wb") as file:
            file.write(_INDEX)
            file.flush()
            os.fsync(file.fileno())
        made.replace(keep)


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that the names of its files are on the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
