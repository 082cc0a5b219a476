"""Context managers that start a rig, or create state repos, for the length of a block."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import pytest

from tests.e2e.common.expected import NAMESPACE
from tests.e2e.common.staterepo import StateRepo
from tests.e2e.rig.cluster import Rig

World = TypeVar("World", bound=StateRepo[Any])


@contextmanager
def running(rig: Rig, session: pytest.Session) -> Iterator[Rig]:
    """Start a rig and stop it after the block; keep its logs if a test failed meanwhile."""
    failed = session.testsfailed
    rig.start()
    try:
        yield rig
    finally:
        if rig.existing:
            rig.kube.delete("Namespace", NAMESPACE)
        rig.stop(failed=session.testsfailed > failed)


@contextmanager
def worlds(make: Callable[[], World]) -> Iterator[Callable[[], World]]:
    """Yield a function that creates state repos, which no cluster follows yet.

    The context manager removes these state repos after the block.
    """
    made: list[World] = []

    def another() -> World:
        made.append(make())
        return made[-1]

    yield another
    for world in made:
        world.remove()
