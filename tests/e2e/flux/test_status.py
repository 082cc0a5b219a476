"""With Flux the answer to a demand reports whether its services run."""

from __future__ import annotations

import pytest

from tests.e2e.common.answers import Answers, World, limited_world
from tests.e2e.rig.cluster import Rig

from .conftest import MakeWorld


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    return limited_world(make_world(), rig, "flux")


class TestFlux(Answers):
    """The tests of `Answers` with Flux."""
