"""Slots: folders for the journal and the clone of each process that uses a state repo."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import IO

from demandops.errors import StateRepoError
from demandops.staterepo.git.new_objects import sync_folder
from demandops.staterepo.write.journal import (
    DamagedJournal,
    Journal,
    JournalEntry,
    read,
    readable_entries,
)

_MAX_SLOTS = 256
_JOURNAL = "outbox.jsonl"


class Slot:
    """A folder for the journal and the clone of one process, locked while the process lives.

    Several processes on one machine may serve one state repo. Each takes the first free slot and
    takes over the journals of dead processes.
    """

    def __init__(self, root: Path) -> None:
        """Take a slot below ``root``; raise StateRepoError, or OSError about the slot's folder."""
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
            raise StateRepoError(f"{_MAX_SLOTS} processes already use {root}; stop some of them")
        try:
            self.journal = Journal(self.folder / _JOURNAL)
            # Take over the journals of dead processes. Each entry is written here before the old
            # journal is removed. If a crash in between leaves the entry in both journals, it still
            # counts once, because its operation id is the same.
            for journal in sorted(root.glob(f"slot-*/{_JOURNAL}")):
                lock = _lock(journal.parent) if journal.parent != self.folder else None
                if lock is not None:
                    with lock:
                        self.journal.append(read(journal).values())
                        journal.unlink()
        except BaseException:
            self._lock.close()
            raise

    def close(self) -> None:
        self.journal.close()
        self._lock.close()


@dataclass(frozen=True, slots=True)
class FoundJournal:
    """A journal on this machine, and its demands that are not done and can be read."""

    file: Path
    demands: list[JournalEntry]
    # the error of reading the journal, if any
    damage: str = ""
    # the file's new path, if it was renamed
    set_aside: Path | None = None


def find_journals(root: Path, now: datetime, *, set_aside: bool) -> Iterator[FoundJournal]:
    """Yield the journals in a data folder that have demands or are damaged.

    If ``set_aside`` is true, each damaged journal is renamed, unless a running process uses it.
    """
    for file in sorted(root.glob(f"slot-*/{_JOURNAL}")):
        try:
            demands = list(read(file).values())
            if demands:
                yield FoundJournal(file, demands)
        except OSError as error:
            message = f"{file} cannot be read: {error.strerror}; check this path, then try again"
            raise StateRepoError(message) from None
        except DamagedJournal as damage:
            moved = None
            lock = _lock(file.parent) if set_aside else None
            if lock is not None:
                with lock:
                    moved = file.rename(file.with_name(f"outbox-{now:%Y%m%dT%H%M%S}.damaged"))
                    sync_folder(file.parent)
            yield FoundJournal(file, readable_entries(moved or file), str(damage), moved)


def _lock(folder: Path) -> IO[str] | None:
    folder.mkdir(exist_ok=True, mode=0o700)
    handle = (folder / "lock").open("w")
    # the kernel releases this lock when the process dies in any way
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        handle.close()
        return None
    return handle
