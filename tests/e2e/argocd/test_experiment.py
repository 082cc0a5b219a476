"""The paper's eight steps with Argo CD: exactly what must run does, where it must."""

from __future__ import annotations

from tests.e2e.common import expected
from tests.e2e.common.expected import FUSION, STEPS
from tests.e2e.common.timing import Table
from tests.e2e.rig.tools import Report

from .world import World


def test_eight_steps_and_the_fusion_is_never_restarted(world: World, say: Report) -> None:
    domain, table = world.domain, Table("From the goal to the pods with Argo CD, asked to look")
    laid_down = domain.inventory()
    fusion: list[tuple[object, ...]] = []
    for step in STEPS:
        times = world.step(step, expected.after(step))
        table.add(f"{step} {expected.title(step)}", times)
        domain.wait_releases_synced()
        assert domain.lines() == expected.after(step), "it was not to stay so"
        if step < STEPS[-1]:
            fusion.append(domain.identity(FUSION))
    table.show(say)
    assert len(set(fusion)) == 1, f"the fusion was rolled out or restarted: {fusion}"
    domain.wait_inventory(laid_down)
