"""New objects of a state repo: in memory until one pack makes them durable.

A pack costs a few syncs, however many commits a batch has; loose objects cost some for each object.
The pack holds every object that its commits need and their parent lacks, also those that the repo
has already: a loose object may not be on the disk yet, or about to be pruned.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import struct
import subprocess
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import pygit2
from pygit2 import Oid, Repository
from pygit2.enums import ObjectType

_TYPES = {ObjectType.COMMIT: b"commit", ObjectType.TREE: b"tree", ObjectType.BLOB: b"blob"}
_LAST = 0
"""The priority of the memory. It is asked last, because most objects that are read are not new."""

UNFINISHED = "demandops-pack-"
"""The prefix of the folders in which packs are built."""
_INDEX = b"\xfftOc"
"""The first bytes of the index of a pack."""

_ENTRY = re.compile(rb"(([0-7]+) ([^\0]+)\0(.{20}))", re.DOTALL)
"""An entry of a tree object: the mode, the name and the raw id."""
_FOLDER = b"40000"

Entries = dict[bytes, bytes]
"""The entries of a folder by name; a folder's name ends in a slash, as Git sorts it."""


class NewObjects(pygit2.OdbBackend):
    """The objects that were written but not packed yet; the repository reads them like others."""

    def __init__(self, repo: Repository) -> None:
        super().__init__()
        self.repo = repo
        self._known: dict[Oid, tuple[ObjectType, bytes]] = {}
        repo.odb.add_backend(self, _LAST)

    def add(self, kind: ObjectType, data: bytes) -> Oid:
        """Keep an object and return its id."""
        header = b"%s %d\0" % (_TYPES[kind], len(data))
        oid = Oid(raw=_sha1(header + data))
        self._known[oid] = (kind, data)
        return oid

    def forget(self) -> None:
        """Drop what is not packed."""
        self._known.clear()

    @contextmanager
    def packed(self, commit: Oid) -> Iterator[None]:
        """Write the new objects that a commit needs as one pack, synced.

        Within the block git's housekeeping keeps the pack, although no reference leads to it yet.
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
        """Write the objects between two commits again, to a new pack, synced, like :meth:`packed`.

        A sync may have failed for the files that have them; then reading these proves nothing.
        """
        with self._placed(lambda folder: self._copy_to_pack(folder, f"{commit}\n^{since}\n")):
            yield

    @contextmanager
    def _placed(self, build: Callable[[str], Path]) -> Iterator[None]:
        """Build a pack and place it before its index: git removes an index without a pack.

        Its .keep is a link to the index, so it needs no sync and :meth:`clean` knows it.
        """
        packs = self._packs
        with (
            _locked(packs, fcntl.LOCK_SH),
            TemporaryDirectory(
                dir=self.repo.path, prefix=UNFINISHED, ignore_cleanup_errors=True
            ) as folder,
        ):
            built = build(folder)
            placed = packs / built.name
            keep = placed.with_suffix(".keep")
            keep.unlink(missing_ok=True)
            try:
                keep.hardlink_to(built.with_suffix(".idx"))
                built.replace(placed)
                built.with_suffix(".idx").replace(placed.with_suffix(".idx"))
                sync_folder(packs)
                yield
            finally:
                with suppress(OSError):  # the next start removes it
                    keep.unlink(missing_ok=True)

    @property
    def _packs(self) -> Path:
        return Path(self.repo.path) / "objects" / "pack"

    def clean(self) -> None:
        """Remove what killed processes left, unless another process writes a pack now."""
        with suppress(OSError), _locked(self._packs, fcntl.LOCK_EX | fcntl.LOCK_NB):
            for folder in Path(self.repo.path).glob(f"{UNFINISHED}*"):
                shutil.rmtree(folder, ignore_errors=True)
            for keep in self._packs.glob("*.keep"):
                with keep.open("rb") as file:
                    is_ours = file.read(len(_INDEX)) == _INDEX
                if is_ours:
                    keep.unlink()

    def _copy_to_pack(self, folder: str, revisions: str) -> Path:
        """Have git read and write objects; it checks their content, and syncs the pack."""
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
        (pack,) = Path(folder).glob("*.pack")
        return pack

    def _build_pack(self, folder: str, needed: list[Oid]) -> Path:
        """Build a pack and its index, synced. It has no deltas: git makes some when it joins packs.

        The format is Git's: https://git-scm.com/docs/gitformat-pack.
        """
        pack = bytearray(struct.pack(">4sII", b"PACK", 2, len(needed)))
        rows = list[tuple[bytes, int, int]]()
        for oid in needed:
            kind, data = self._known[oid]
            packed = _size_in_pack(kind, len(data)) + zlib.compress(data, 1)
            rows.append((oid.raw, zlib.crc32(packed), len(pack)))
            pack += packed
        pack += _sha1(pack)
        raws, checksums, offsets = zip(*sorted(rows), strict=True)
        firsts = [raw[0] for raw in raws]
        fanout = (bisect_right(firsts, byte) for byte in range(256))
        index = struct.pack(">4sI256I", _INDEX, 2, *fanout) + b"".join(raws)
        index += struct.pack(f">{len(raws)}I{len(raws)}i", *checksums, *offsets) + pack[-20:]
        path = Path(folder) / f"pack-{_sha1(b''.join(raws)).hex()}.pack"
        for file, content in (path, pack), (path.with_suffix(".idx"), index + _sha1(index)):
            with open(file, "wb", opener=_read_only) as writing:
                writing.write(content)
                writing.flush()
                os.fsync(writing.fileno())
        return path

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
                queue += [known[raw] for *_, raw in _ENTRY.findall(data) if raw in known]
        return list(needed)

    # ---- what libgit2 calls ----

    def __iter__(self) -> Iterator[Oid]:
        """Iterate over the ids of the new objects."""
        return iter(self._known)

    def exists_cb(self, oid: Oid) -> bool:
        """Return whether this is a new object."""
        return oid in self._known

    def read_cb(self, oid: Oid) -> tuple[int, bytes]:
        """Return the type and the content of a new object."""
        return self._known[oid]

    def read_header_cb(self, oid: Oid) -> tuple[int, int]:
        """Return the type and the size of a new object."""
        kind, data = self._known[oid]
        return kind, len(data)

    def read_prefix_cb(self, oid: Oid) -> tuple[int, bytes, Oid]:
        """Return type, content and id of a new object; only full ids are looked up."""
        kind, data = self._known[oid]
        return kind, data, oid

    def refresh_cb(self) -> None:
        """Do nothing: memory is always current."""


def _read_only(path: str, flags: int) -> int:
    return os.open(path, flags, 0o444)


def _sha1(data: bytes | bytearray) -> bytes:
    return hashlib.sha1(data).digest()  # noqa: S324 - Git's object ids


def _size_in_pack(kind: ObjectType, size: int) -> bytes:
    """Return the type and size of an object as a pack has them: 4 bits of the size, then 7 each."""
    written, size = bytearray([kind << 4 | size & 15]), size >> 4
    while size:
        written[-1] |= 128
        written.append(size & 127)
        size >>= 7
    return bytes(written)


def entries_of(data: bytes) -> Entries:
    """Return the entries of a tree object."""
    return {
        name + b"/" if mode == _FOLDER else name: entry
        for entry, mode, name, _ in _ENTRY.findall(data)
    }


@contextmanager
def _locked(folder: Path, how: int) -> Iterator[None]:
    """Hold a lock of a folder; whoever writes packs shares it."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, how)
        yield
    finally:
        os.close(handle)


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that the names of its files are on the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
