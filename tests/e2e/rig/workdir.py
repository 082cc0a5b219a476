"""The folder of one rig: its data, its logs, and how both go away again.

A rig holds a lock on its folder for as long as it lives. A folder whose lock is free belonged to a
test run that was killed: the next rig removes it, for an etcd alone takes over a hundred megabytes.
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
_YOUNG_SECONDS = 60  # another rig may have made its file and not locked it yet


class Workdir:
    """A rig's folder; `logs` outlives a failure, the rest does not."""

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
        """HOME of the processes: nothing of the person's own must reach them."""
        return self.path / "home"

    @property
    def temporary(self) -> Path:
        """TMPDIR of the processes, so that a killed one leaves nothing elsewhere."""
        return self.path / "tmp"

    @property
    def repositories(self) -> Path:
        """Root of the Git server."""
        return self.path / "git"

    def environment(self) -> dict[str, str]:
        """What every process of the rig gets, and nothing else of the person's environment."""
        return {
            "PATH": os.environ.get("PATH", os.defpath),
            "HOME": str(self.home),
            "TMPDIR": str(self.temporary),
            "NO_PROXY": "127.0.0.1,localhost",
        }

    def clear(self, *, keep_logs: bool) -> None:
        """Remove the data, and the logs too unless somebody will want to read them."""
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
        with contextlib.suppress(OSError):  # held by a living rig, somebody else's, or just gone
            if time.time() - left.stat().st_mtime > _YOUNG_SECONDS:
                with _locked(left):
                    shutil.rmtree(left.parent, ignore_errors=True)
