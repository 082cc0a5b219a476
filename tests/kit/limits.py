"""How long tests wait for what must happen, and a limit on the size of files like a full disk's."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager

# These only end what hangs. They must be far above what anything takes on a busy machine.
PATIENCE_S = 240.0
LONGEST_TEST_S = 600.0


@contextmanager
def files_end_at(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))  # Python ignores SIGXFSZ
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
