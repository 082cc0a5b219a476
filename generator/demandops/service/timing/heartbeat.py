"""Shows a supervisor, such as a pod's liveness probe, that the worker is not stuck."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


class Heartbeat:
    """Touches a file whenever it is called; each turn of the worker and each wait for git calls it.

    So the file grows old only if the worker is stuck, and not because a remote is away. Until the
    first call there is no file, because a start may have to clone for long.
    """

    def __init__(self, file: Path | None) -> None:
        """Remove the file of an earlier process. With None, do nothing now and in each call."""
        self._file = file
        if file is not None:
            with suppress(OSError):
                file.unlink()

    def __call__(self) -> None:
        """Touch the file."""
        if self._file is not None:
            with suppress(OSError):
                self._file.touch()
