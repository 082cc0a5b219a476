"""The paper's eight steps: exactly the right services run on the right nodes."""

from __future__ import annotations

from tests.e2e.common import expected
from tests.e2e.common.expected import FUSION, STEPS
from tests.e2e.common.world import World


def test_eight_steps_and_the_fusion_is_never_restarted(world: World) -> None:
    domain = world.domain
    at_first = domain.inventory()
    fusion: list[tuple[object, ...]] = []
    for step in STEPS:
        world.step(step, expected.after(step))
        domain.wait_releases()
        assert domain.lines() == expected.after(step), "the namespace changed again"
        if step < STEPS[-1]:
            fusion.append(domain.identity(FUSION))
    assert len(set(fusion)) == 1, f"the fusion was rolled out or restarted: {fusion}"
    domain.wait_inventory(at_first)
