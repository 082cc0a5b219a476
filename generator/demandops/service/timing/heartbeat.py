"""Shows a supervisor, such as a pod's liveness probe, that the worker is not stuck."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


class Heartbeat:
    """Touches a file in each turn of the worker and at each wait for git."""

    # So the file grows old only if the worker is stuck, and not because a remote is away.

    def __init__(self, file: Path | None) -> None:
        self._file = file
        # an earlier process may have left one; until the first turn there is none, because a start
        # may have to clone for long
        if file is not None:
            with suppress(OSError):
                file.unlink()

    def __call__(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.touch()
