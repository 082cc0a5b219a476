"""Writes and syncs a pack and its index in Git's format.

Each object is compressed and stored whole, not as a delta, because the search for deltas would take
longer than the rest of a demand's commit. Git's housekeeping makes deltas later.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from pygit2 import Oid
from pygit2.enums import ObjectType

_KINDS = {ObjectType.COMMIT: 1, ObjectType.TREE: 2, ObjectType.BLOB: 3}
# The level of compression. A pack is short-lived, so speed counts more than size.
_LEVEL = 1
# An index has a separate table for offsets of at least this value.
_SHORT_OFFSETS = 1 << 31


class Packed(NamedTuple):
    """An object in a pack: its id, and the checksum and the offset of its packed bytes."""

    oid: bytes
    crc: int
    offset: int


def write_pack(folder: Path, objects: Sequence[tuple[Oid, ObjectType, bytes]]) -> Path:
    """Write a pack and its index into a folder, sync both, and return the pack's path."""
    parts = [b"PACK" + struct.pack(">II", 2, len(objects))]
    packed, offset = list[Packed](), len(parts[0])
    for oid, kind, data in objects:
        part = _header(_KINDS[kind], len(data)) + zlib.compress(data, _LEVEL)
        packed.append(Packed(oid.raw, zlib.crc32(part), offset))
        parts.append(part)
        offset += len(part)
    checksum = _sha1(parts)
    path = folder / f"pack-{checksum.hex()}.pack"
    _write_synced(path, [*parts, checksum])
    _write_synced(path.with_suffix(".idx"), index_of(packed, checksum))
    return path


def _header(kind: int, size: int) -> bytes:
    # 4 bits of the size are beside the type, and 7 in each further byte; the top bit means more
    byte, size = kind << 4 | size & 0xF, size >> 4
    header = bytearray()
    while size:
        header.append(byte | 0x80)
        byte, size = size & 0x7F, size >> 7
    header.append(byte)
    return bytes(header)


def index_of(packed: Iterable[Packed], checksum: bytes) -> list[bytes]:
    """Return the bytes of the index (version 2) of a pack with this checksum, in parts."""
    packed = sorted(packed)
    firsts = [item.oid[0] for item in packed]
    far = [item.offset for item in packed if item.offset >= _SHORT_OFFSETS]
    places = {offset: _SHORT_OFFSETS | place for place, offset in enumerate(far)}
    parts = [
        b"\xfftOc" + struct.pack(">I", 2),
        # git looks an id up by its first byte: how many ids begin with at most this byte
        struct.pack(">256I", *(bisect_right(firsts, first) for first in range(256))),
        b"".join(item.oid for item in packed),
        struct.pack(f">{len(packed)}I", *(item.crc for item in packed)),
        struct.pack(f">{len(packed)}I", *(places.get(i.offset, i.offset) for i in packed)),
        struct.pack(f">{len(far)}Q", *far),
        checksum,
    ]
    return [*parts, _sha1(parts)]


def _sha1(parts: Iterable[bytes]) -> bytes:
    digest = hashlib.sha1()  # noqa: S324 - Git's checksums
    for part in parts:
        digest.update(part)
    return digest.digest()


def _write_synced(path: Path, parts: Iterable[bytes]) -> None:
    # read-only, like git's packs
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o444)
    with open(handle, "wb") as file:  # noqa: PTH123 - opens a file descriptor
        file.writelines(parts)
        file.flush()
        os.fsync(handle)
