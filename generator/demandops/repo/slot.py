"""Folders on this machine: each holds the clone and the journal of one process at a time."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import IO

from demandops.base.errors import StateRepoError

_MAX_SLOTS = 256


class Slot:
    # Locked while its process lives. Several processes on one machine may serve one state repo;
    # each takes the first free slot.

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
            self.folder = root / f"slot-{number}"
            if (held := lock(self.folder)) is not None:
                self._lock = held
                return
        raise StateRepoError(f"{_MAX_SLOTS} processes already use {root}; stop some of them")

    def close(self) -> None:
        self._lock.close()


def lock(folder: Path) -> IO[str] | None:
    folder.mkdir(exist_ok=True, mode=0o700)
    handle = (folder / "lock").open("w")
    # the kernel releases this lock when the process dies in any way
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        handle.close()
        return None
    return handle
