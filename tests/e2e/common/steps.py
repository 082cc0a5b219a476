"""Tests of the paper's steps that are the same with each controller.

A test module imports those that it runs; its `world` fixture decides the controller.
"""

from __future__ import annotations

from tests.e2e.rig.tools import Report

from . import expected
from .expected import FUSION, STEPS, WITHOUT_DEMANDS, unscheduled
from .namespace import Namespace
from .staterepo import StateRepo
from .timing import Table


def test_eight_steps_and_the_fusion_is_never_restarted(
    world: StateRepo[Namespace], say: Report
) -> None:
    domain = world.domain
    table = Table(f"From the goal to the pods with {world.rig.gitops}, woken by the test")
    at_first = domain.inventory()
    fusion: list[tuple[object, ...]] = []
    for step in STEPS:
        times = world.step(step, expected.after(step))
        table.add(f"{step} {expected.title(step)}", times)
        domain.wait_releases()
        assert domain.lines() == expected.after(step), "the namespace changed again"
        if step < STEPS[-1]:
            fusion.append(domain.identity(FUSION))
    table.show(say)
    assert len(set(fusion)) == 1, f"the fusion was rolled out or restarted: {fusion}"
    domain.wait_inventory(at_first)


def test_a_service_that_cannot_start_is_reconfigured_and_removed(
    world: StateRepo[Namespace], edge_is_full: object
) -> None:
    """Demands do not wait for it. Helm itself would wait five minutes."""
    domain = world.domain
    for step in (1, 2, 3):
        sent = world.demand(expected.demand(step))
        domain.wake()
        domain.wait_applied(sent.commit)
        domain.wait_lines(unscheduled(expected.after(step)))
    for step in (1, 2, 3):
        sent = world.demand(expected.demand(step) | {"shutdown": True})
    domain.wake()
    domain.wait_applied(sent.commit)
    domain.wait_lines(WITHOUT_DEMANDS)
