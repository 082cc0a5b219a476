"""A service that cannot start: what is demanded meanwhile does not wait for it."""

from __future__ import annotations

from tests.e2e.common import expected
from tests.e2e.common.expected import STANDING, unscheduled

from .world import World

PATIENCE_S = 60.0  # Helm's own is five minutes


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
