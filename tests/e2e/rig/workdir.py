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
    """The folder of a rig.

    Its lock is held until `clear`.
    """

    def __init__(self, name: str, path: Path | None = None) -> None:
        if path is None:
            _sweep(Path(tempfile.gettempdir()))
            path = Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{name}-"))
        else:
            path.mkdir(parents=True, exist_ok=True)
        self.path = path.resolve()
        self.logs = self.path / "logs"
        self._lock = _locked(self.path / "lock")
        for folder in (self.logs, self.home, self.temporary, self.repositories):
            folder.mkdir(exist_ok=True)

    @property
    def home(self) -> Path:
        """The HOME of the rig's processes, which contains no file of the user."""
        return self.path / "home"

    @property
    def temporary(self) -> Path:
        """The TMPDIR of the rig's processes, so that a killed process leaves no files elsewhere."""
        return self.path / "tmp"

    @property
    def repositories(self) -> Path:
        """The root folder of the Git server."""
        return self.path / "git"

    def environment(self) -> dict[str, str]:
        """Return the environment of the rig's processes; only PATH comes from the user."""
        return {
            "PATH": os.environ.get("PATH", os.defpath),
            "HOME": str(self.home),
            "TMPDIR": str(self.temporary),
            "NO_PROXY": "127.0.0.1,localhost",
        }

    def clear(self, *, keep_logs: bool) -> None:
        """Remove the data, and the logs too unless `keep_logs`."""
        for entry in self.path.iterdir():
            if entry == self.logs and keep_logs:
                continue
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
