"""With Argo CD the answer to a demand reports whether its services run."""

from __future__ import annotations

from typing import Any

import pytest

from tests.e2e.common.answers import Answers, World, limited_world
from tests.e2e.rig.cluster import Rig

from .conftest import MakeWorld


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    return limited_world(make_world(), rig, "argo cd")


class TestArgoCD(Answers):
    def read_repaired_chart(self, world: Any) -> None:
        """Make Argo CD read the chart now; by itself, Argo CD reads it only every few minutes."""
        world.domain.refresh("od-edge-vehicle00")
