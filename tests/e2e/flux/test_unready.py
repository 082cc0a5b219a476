"""A service that cannot start: what is demanded meanwhile does not wait for it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.common import expected
from tests.e2e.common.expected import STANDING
from tests.e2e.rig.cluster import Rig

from .world import World

PATIENCE_S = 60.0  # Helm's own is five minutes


@pytest.fixture
def edge_is_full(rig: Rig) -> Iterator[None]:
    """No pod is scheduled on the edge, as when an image cannot be pulled there."""
    (edge,) = rig.kube.find("Node", selector="node_id=edge")
    for state, whole in ((True, False), (False, True)):
        if whole:
            yield
        name = edge["metadata"]["name"]
        rig.kube.patch("Node", name, {"spec": {"unschedulable": state or None}})


def test_a_service_that_cannot_start_is_reconfigured_and_removed(
    world: World, edge_is_full: None
) -> None:
    domain = world.domain
    for step in (1, 2, 3):
        sent = world.demand(expected.demand(step))
        domain.wake()
        domain.wait_applied(sent.commit)
        domain.wait_lines(unscheduled(expected.after(step)), PATIENCE_S)
    for step in (1, 2, 3):
        sent = world.demand(expected.demand(step) | {"shutdown": True})
    domain.wake()
    domain.wait_applied(sent.commit)
    domain.wait_lines(STANDING, PATIENCE_S)


def unscheduled(lines: frozenset[str]) -> frozenset[str]:
    """The same with the edge's pods waiting for a node."""
    return frozenset(line.replace(" on edge, ready", " on no node, not ready") for line in lines)
