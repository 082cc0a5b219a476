"""The folder of a rig, with its data and logs.

A rig holds a lock on its folder while it lives. A folder whose lock is free belonged to a test run
that was killed. The next rig removes that folder, because the data of etcd alone takes over a
hundred megabytes.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import IO

_PREFIX = "demandops-rig-"
_YOUNG_SECONDS = 60  # a younger lock file may belong to a rig that is about to lock it


class Workdir:
    """The folder of a rig; its lock is held until `clear`.

    `home` and `temporary` are HOME and TMPDIR of the rig's processes, which so read no file of the
    user and leave none elsewhere. `repositories` is the root folder of the Git server.
    """

    def __init__(self, name: str) -> None:
        _sweep(Path(tempfile.gettempdir()))
        self.path = Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{name}-")).resolve()
        self._lock = _locked(self.path / "lock")
        folders = [self.path / part for part in ("logs", "home", "tmp", "git")]
        self.logs, self.home, self.temporary, self.repositories = folders
        for folder in folders:
            folder.mkdir()

    def environment(self) -> dict[str, str]:
        """Return the environment of the rig's processes; only PATH comes from the user."""
        return {
            "PATH": os.environ.get("PATH", os.defpath),
            "HOME": str(self.home),
            "TMPDIR": str(self.temporary),
            "NO_PROXY": "127.0.0.1,localhost",
        }

    def clear(self, *, keep_logs: bool) -> None:
        for entry in {*self.path.iterdir()} - ({self.logs} if keep_logs else set()):
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)
        self._lock.close()
        if not keep_logs:
            shutil.rmtree(self.path, ignore_errors=True)


def _locked(path: Path) -> IO[str]:
    lock = path.open("a")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise
    return lock


def _sweep(parent: Path) -> None:
    for left in parent.glob(f"{_PREFIX}*/lock"):
        with contextlib.suppress(OSError):  # locked by its rig, another user's, or just removed
            if time.time() - left.stat().st_mtime > _YOUNG_SECONDS:
                with _locked(left):
                    shutil.rmtree(left.parent, ignore_errors=True)
