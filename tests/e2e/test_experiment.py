"""The paper's eight steps: exactly the right services run on the right nodes."""

from __future__ import annotations

from tests.e2e.common import expected
from tests.e2e.common.expected import FUSION, STEPS
from tests.e2e.common.world import World, show_times
from tests.e2e.rig.tools import Report


def test_eight_steps_and_the_fusion_is_never_restarted(world: World, say: Report) -> None:
    domain = world.domain
    times: dict[str, list[float]] = {}
    at_first = domain.inventory()
    fusion: list[tuple[object, ...]] = []
    for step in STEPS:
        times[f"{step} {expected.title(step)}"] = world.step(step, expected.after(step))
        domain.wait_releases()
        assert domain.lines() == expected.after(step), "the namespace changed again"
        if step < STEPS[-1]:
            fusion.append(domain.identity(FUSION))
    show_times(say, f"From the goal to the pods with {world.rig.gitops}, woken by the test", times)
    assert len(set(fusion)) == 1, f"the fusion was rolled out or restarted: {fusion}"
    domain.wait_inventory(at_first)
