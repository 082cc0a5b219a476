"""Two kinds of faults: the disk of the state repo or of the journal is full; a file is damaged."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.faults.injection import Result
from tests.faults.invariants import DEMAND, NEXT, after_fault, after_restart
from tests.faults.rig import Ran, Rig, Strace
from tests.faults.trace import file_class

_UNREAD = re.compile(r"\.git/(hooks/|info/|description|FETCH_HEAD)")
_BLOCK = 4096
_SIZE = 4 << 20
_OWN_MOUNTS = 0x20000  # CLONE_NEWNS
_ROOM = ("no room", os.strerror(28))


def may_mount() -> bool:
    if ctypes.CDLL(None).unshare(_OWN_MOUNTS) != 0:
        return False
    return subprocess.run(["mount", "--make-rprivate", "/"], check=False).returncode == 0


def full(rig: Rig, folder: Path, blocks: int) -> Result:
    """Book a demand with ``blocks`` free blocks, then restart with more room."""
    rig.restore()
    with _small_disk(folder):
        filler = folder / "filler"
        free = os.statvfs(folder).f_bavail - blocks
        filler.write_bytes(bytes(free * _BLOCK))
        ran = rig.book(DEMAND)
        problems = list(after_fault(ran, _ROOM, unsound=False))
        filler.unlink()
        problems += after_restart(rig, ran)
    return Result((folder.name, f"{blocks} blocks left"), "", tuple(problems))


@contextmanager
def _small_disk(folder: Path) -> Iterator[None]:
    aside = folder.rename(folder.with_name("aside"))
    folder.mkdir()
    options = f"size={_SIZE},mode=0700"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", folder], check=True)
    try:
        shutil.copytree(aside, folder, symlinks=True, dirs_exist_ok=True)
        shutil.rmtree(aside)
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def interrupted(rig: Rig) -> None:
    """Kill a process when its demand is in the journal and not yet published; save all files."""
    rig.restore()
    kill = ("-e", "trace=mkdir", "-e", "inject=mkdir:signal=KILL:when=1")
    ran = rig.book(DEMAND, Strace(kill, "demandops-writer"))
    assert ran.code < 0, ran
    rig.save()


def damage(rig: Rig, *, short: bool) -> Iterator[Result]:
    """Change a byte of one file of each class, or cut it; yield the result of the next start."""
    rig.restore()
    classes: dict[str, tuple[Path, int]] = {}
    for path in sorted(rig.folder.rglob("*")):
        name = file_class(str(path), rig.folder)
        if path.is_file() and not _UNREAD.search(name):
            if rig.remote and name.startswith("state.git/"):
                continue
            if path.stat().st_size:
                classes[name] = path, path.stat().st_size
    for name, (path, size) in classes.items():
        places = {0: "the first", size // 2: "a middle", size - 1: "the last"}
        for place, title in places.items():
            yield _damaged(rig, path, name, place, f"{title} byte is changed")
        for place in (0, size // 2) if short else range(0, size, max(1, size // 8)):
            yield _damaged(rig, path, name, -place - 1, f"cut at {place} of {size}")


def _damaged(rig: Rig, path: Path, name: str, place: int, title: str) -> Result:
    rig.restore()
    text = bytearray(path.read_bytes())
    if place < 0:
        del text[-place - 1 :]
    else:
        text[place] ^= 0x24
    path.unlink()
    path.write_bytes(text)
    ran = rig.book(NEXT)
    told = (str(path.parent), path.name, "journal", "damaged", rig.address)
    problems = list(after_fault(ran, told, unsound=False))
    mendable = rig.remote and "clone.git" in name
    if ran.code and mendable:
        problems.append(f"not mended: {ran.err.strip()[-200:]}")
    if not ran.code and (mendable or "outbox" in name):
        problems += after_restart(rig, Ran(0, "", ""), clones=False)
    return Result((name, title), "", tuple(problems))
