"""The journal: every accepted demand that is not yet published, on disk, so a crash loses none.

It has one JSON line for each demand received and one for each demand done. A demand is written and
fsynced before it is evaluated. After a restart, demands that are not done are evaluated again;
their operation ids show whether a commit was already published.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import IO, Any

from demandops.errors import StateRepoError

_COMPACT_ABOVE = 1 << 20
_MAX_SLOTS = 256


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """An accepted demand: operation id, goal, time received, and the tip known then.

    ``proposal``: the proposal with which it awaits approval, if any.
    """

    operation: str
    goal: Any
    received: str
    base: str
    proposal: dict[str, Any] | None = None

    def line(self) -> str:
        """Return its line of the journal, without copying the goal, which may be deep."""
        record = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.proposal is None:
            del record["proposal"]
        return json.dumps(record, ensure_ascii=True) + "\n"


class Journal:
    """The journal of one process. Not thread-safe: the caller locks."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.pending: dict[str, JournalEntry] = _load(path)
        self._compact()

    def append(self, entries: Iterable[JournalEntry]) -> None:
        """Write and fsync ``entries``."""
        lines = []
        for entry in entries:
            self.pending[entry.operation] = entry
            lines.append(entry.line())
        if lines:
            self._file.write("".join(lines))
            self._sync()

    def mark_done(self, operations: Iterable[str], *, durably: bool = False) -> None:
        """Remove demands that are published, refused or withdrawn.

        Fsynced only if ``durably``: without a later demand it is harmless to replay these, and the
        :meth:`append` of a later demand fsyncs them too.
        """
        for operation in operations:
            if self.pending.pop(operation, None) is not None:
                self._file.write(json.dumps({"done": operation}) + "\n")
        self._file.flush()
        if durably:
            self._sync()
        if not self.pending and self._file.tell() > _COMPACT_ABOVE:
            self._compact()

    def close(self) -> None:
        """Close the journal; pending demands stay for the next process."""
        self._sync()
        self._file.close()

    def _sync(self) -> None:
        self._file.flush()
        os.fdatasync(self._file.fileno())

    def _compact(self) -> None:
        fresh = self._path.with_suffix(".new")
        with fresh.open("w") as file:
            for entry in self.pending.values():
                file.write(entry.line())
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(self._path)
        _sync_folder(self._path.parent)
        self._file: IO[str] = self._path.open("a")


def _load(path: Path) -> dict[str, JournalEntry]:
    """Return the pending demands; skip a line that a crash cut off, which was not acknowledged."""
    pending: dict[str, JournalEntry] = {}
    text = path.read_bytes().decode("utf-8", "replace") if path.exists() else ""
    for line in text.splitlines():
        try:
            record = json.loads(line)
            if "done" in record:
                pending.pop(record["done"], None)
            else:
                datetime.fromisoformat(record["received"])
                pending[record["operation"]] = JournalEntry(**record)
        except (ValueError, TypeError, KeyError, AttributeError):
            continue
    return pending


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class Slot:
    """A folder for the journal and the clone of one process, locked while the process lives.

    Several processes on one machine may serve one state repo. Each takes the first free slot and
    takes over the journals of dead processes.
    """

    def __init__(self, root: Path) -> None:
        try:
            root.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise StateRepoError(
                f"the data folder {root} cannot be made: {error.strerror}; set DEMANDOPS_DATA_HOME "
                "to a writable folder"
            ) from None
        for number in range(_MAX_SLOTS):
            folder = root / f"slot-{number}"
            lock = _lock(folder)
            if lock is not None:
                self.folder, self._lock = folder, lock
                break
        else:
            raise OSError(f"{_MAX_SLOTS} processes already use {root}")
        self.journal = Journal(self.folder / "outbox.jsonl")
        self._adopt_orphans(root)

    def _adopt_orphans(self, root: Path) -> None:
        """Take over the journals of dead processes.

        An entry is written here before it is removed there. A crash between the two leaves it
        twice, but its operation id makes it count once.
        """
        for folder in sorted(root.glob("slot-*")):
            journal = folder / "outbox.jsonl"
            if folder == self.folder or not journal.exists():
                continue
            lock = _lock(folder)
            if lock is not None:
                with lock:
                    self.journal.append(_load(journal).values())
                    journal.unlink()

    def close(self) -> None:
        """Close the journal and release the slot."""
        self.journal.close()
        self._lock.close()


def _lock(folder: Path) -> IO[str] | None:
    folder.mkdir(exist_ok=True, mode=0o700)
    handle = (folder / "lock").open("w")
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        handle.close()
        return None
    return handle
