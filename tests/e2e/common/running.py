"""A rig for the length of a block."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.e2e.rig.cluster import Rig

NAMESPACE = "perception"  # the skeleton's access domain


@contextmanager
def running(rig: Rig, session: pytest.Session) -> Iterator[Rig]:
    """Start a rig and stop it at the end; its logs remain if a test failed meanwhile."""
    failed = session.testsfailed
    rig.start()
    try:
        yield rig
    finally:
        if rig.existing:
            rig.kube.delete("Namespace", NAMESPACE)
        rig.stop(failed=session.testsfailed > failed)
