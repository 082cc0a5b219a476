"""Power loss, in the manner of ALICE: the disk as it may be when unsynced changes are gone.

A model of the disk follows the system calls of a demand. A change of a file's content is safe once
the file is synced. A change of a name is safe once its folder is synced. At each sync and at the
end, the model writes the disk in several states: without any unsafe change, with all of them, and
with each single unsafe change missing.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.injection import SYNCS, Result
from tests.faults.invariants import DEMAND, after_restart
from tests.faults.rig import Ran, Rig, Strace
from tests.faults.trace import Call

_TRACE = ("-f", "-s", "16000000", "-e", "trace=%file,%desc,%process")
_FOLDER = -1
_GONE = -2


@dataclass(frozen=True)
class _Part:
    """A change of a folder's entry, if it has a ``path``, or of a file: bytes at ``at``, or a cut.

    It is safe when the folder or the file is synced, which is its ``scope``.
    """

    node: int
    path: str = ""
    at: int = 0
    text: bytes | None = None

    @property
    def scope(self) -> str | int:
        return self.path.rpartition("/")[0] or self.node


@dataclass
class _Change:
    """A change by one call or by successive writes; indices of ``parts`` are safe or lost."""

    name: str
    parts: list[_Part]
    safe: set[int] = field(default_factory=set)
    lost: set[int] = field(default_factory=set)

    @property
    def is_safe(self) -> bool:
        return len(self.safe) == len(self.parts)


class Disk:
    def __init__(self, root: Path, *, always_safe: str = "") -> None:
        self.root = root
        self._always_safe = always_safe
        self._names: dict[str, int] = {}
        self._first_data: dict[int, bytes] = {}
        self._sizes: dict[int, int] = {}
        self._places: dict[str, int] = {}
        self.changes: list[_Change] = []
        for path in sorted(root.rglob("*")):
            node = _FOLDER
            if path.is_file():
                node = len(self._sizes)
                self._first_data[node] = path.read_bytes()
                self._sizes[node] = len(self._first_data[node])
            self._names[str(path)] = node
        self._first_names = dict(self._names)

    def follow(self, call: Call) -> None:
        path = call.paths[-1]
        if call.kind in SYNCS:
            self._sync(path, worked=not call.failed)
        elif not call.failed:
            parts = list(self._parts(call, path))
            if parts:
                change = _Change(f"{call.kind} {call.file}", parts)
                if self._always_safe and path.startswith(self._always_safe):
                    change.safe = set(range(len(parts)))
                self._append(change)

    def _append(self, change: _Change) -> None:
        """Add a change; join it to the last one if both are to one file and no part is safe yet."""
        if self.changes and change.parts and not change.safe:
            last = self.changes[-1]
            parts = [*last.parts, *change.parts]
            same = all(not p.path and p.scope == parts[0].scope for p in parts)
            if same and not last.safe and not last.lost:
                last.parts = parts
                return
        self.changes.append(change)

    def _parts(self, call: Call, path: str) -> Iterator[_Part]:
        kind, flags = call.kind, call.arguments
        if kind in ("openat", "open", "creat"):
            self._places[path] = -1 if "O_APPEND" in flags else 0
            if path not in self._names and ("O_CREAT" in flags or kind == "creat"):
                node = len(self._sizes)
                self._sizes[node] = 0
                yield self._name(path, node)
            elif "O_TRUNC" in flags:
                yield from self._cut(path, 0)
        elif kind in ("write", "pwrite64"):
            node = self._names.get(path, _GONE)
            if node >= 0:
                place = self._places.get(path, 0)
                at = self._sizes[node] if place < 0 else place
                if kind == "pwrite64":
                    at = int(flags.rpartition(",")[2])
                text = call.text[: int(call.result.split()[0])]
                self._sizes[node] = max(self._sizes[node], at + len(text))
                if place >= 0:
                    self._places[path] = at + len(text)
                yield _Part(node, at=at, text=text)
        elif kind in ("ftruncate", "truncate"):
            yield from self._cut(path, int(flags.rpartition(",")[2]))
        elif kind in ("link", "linkat"):
            yield self._name(path, self._names[call.paths[0]])
        elif kind in ("rename", "renameat", "renameat2"):
            yield from self._renamed(call.paths[0], path)
        elif kind in ("mkdir", "mkdirat"):
            yield self._name(path, _FOLDER)
        elif kind in ("unlink", "unlinkat", "rmdir") and path in self._names:
            yield self._name(path, _GONE)

    def _renamed(self, old: str, new: str) -> Iterator[_Part]:
        for path in [p for p in self._names if p == old or p.startswith(f"{old}/")]:
            yield self._name(new + path.removeprefix(old), self._names[path])
            yield self._name(path, _GONE)

    def _cut(self, path: str, at: int) -> Iterator[_Part]:
        node = self._names.get(path, _GONE)
        if node >= 0:
            self._sizes[node] = at
            yield _Part(node, at=at)

    def _name(self, path: str, node: int) -> _Part:
        if node == _GONE:
            self._names.pop(path, None)
        else:
            self._names[path] = node
        return _Part(node, path)

    def _sync(self, path: str, *, worked: bool) -> None:
        """Mark changes as safe, or as lost if the sync failed; a later sync does not help."""
        node = self._names.get(path, _GONE)
        scope = path if node == _FOLDER else node
        for change in self.changes:
            for index, part in enumerate(change.parts):
                if part.scope == scope and index not in change.lost:
                    (change.safe if worked else change.lost).add(index)

    def states(self) -> Iterator[tuple[str, list[_Change]]]:
        unsafe = [change for change in self.changes if not change.is_safe]
        yield "nothing unsynced", unsafe
        yield "all", []
        for change in unsafe:
            yield f"without {change.name}", [change]

    def write(self, missing: Iterable[_Change]) -> None:
        """Write the folder as a power loss leaves it: without the unsafe parts of ``missing``."""
        left_out = {id(change) for change in missing}
        names = dict(self._first_names)
        data = {node: bytearray(text) for node, text in self._first_data.items()}
        for change in self.changes:
            for index, part in enumerate(change.parts):
                if id(change) in left_out and index not in change.safe:
                    continue
                if part.path:
                    names[part.path] = part.node
                    continue
                content = data.setdefault(part.node, bytearray())
                if part.text is None:
                    del content[part.at :]
                    continue
                content.extend(bytes(max(0, part.at - len(content))))
                content[part.at : part.at + len(part.text)] = part.text
        shutil.rmtree(self.root)
        self.root.mkdir()
        for name in sorted(names):
            path, node = Path(name), names[name]
            if node == _GONE or not path.parent.is_dir():
                continue
            if node == _FOLDER:
                path.mkdir()
            else:
                path.write_bytes(data.get(node, b""))


def run(rig: Rig) -> Iterator[Result]:
    """Book a demand; restart from each disk that a power loss could leave at a sync or the end."""
    rig.restore()
    disk = Disk(rig.folder, always_safe=str(rig.state) if rig.remote else "")
    ran = rig.must(rig.book(DEMAND, Strace(_TRACE)))
    seen, number = set[object](), 0
    for call in ran.calls:
        if call.kind in SYNCS:
            number += 1
            yield from _lose(rig, disk, f"at sync {number}, {call.file}", Ran(0, "", ""), seen)
        disk.follow(call)
    yield from _lose(rig, disk, "at the answer", ran, seen)


def _lose(rig: Rig, disk: Disk, when: str, ran: Ran, seen: set[object]) -> Iterator[Result]:
    for title, missing in disk.states():
        disk.write(missing)
        files = sorted(path for path in rig.folder.rglob("*") if path.is_file())
        state = (*((str(path), hash(path.read_bytes())) for path in files), (ran.commit, 0))
        if state in seen:
            continue
        seen.add(state)
        if rig.remote:  # the server lost no power, so it leaves no locks
            rig.unlock_server()
        yield Result((when, title), "", tuple(after_restart(rig, ran)))


def failed_sync(rig: Rig, number: int) -> Result:
    """Fail a sync, start again, then lose power.

    The next start can still read what was not synced, but must write it again.
    """
    rig.restore()
    disk = Disk(rig.folder)
    broken = (*_TRACE, "-e", f"inject=fsync:error=EIO:when={number}")
    first = rig.book(DEMAND, Strace(broken))
    again = rig.must(rig.book(0, Strace(_TRACE)))  # demand 0 is booked already
    files = set()
    for ran in (first, again):
        for call in ran.calls:
            disk.follow(call)
            if "INJECTED" in call.result:
                files.add(call.file)
    unsafe = [change for change in disk.changes if not change.is_safe]
    disk.write(unsafe)
    problems = tuple(after_restart(rig, again, journaled=True))
    return Result((*files, "and a restart"), "EIO", problems)
