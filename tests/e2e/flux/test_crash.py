"""Whatever is killed in the middle of the sequence, and started again: the same end state."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.e2e.common import expected
from tests.e2e.common.expected import STEPS
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report

from .world import World

Act = Callable[[World, dict[str, Any]], None]


def test_eight_steps_with_a_kill_in_each(world: World, rig: Rig, say: Report) -> None:
    if rig.existing:
        pytest.skip("the parts of an existing cluster are not ours to kill")
    domain = world.domain
    laid_down = domain.inventory()
    for step in STEPS:
        before, start = world.tip(), time.monotonic()
        what, play = KILLS[step]
        play(world, expected.demand(step))
        domain.wait_lines(expected.after(step))
        say(f"  {step}: {what}: as wanted after {time.monotonic() - start:.1f} s")
        assert world.commits_since(before) == 1, "one demand, one commit"
    domain.wait_inventory(laid_down)


def helm_at_work(world: World, goal: dict[str, Any]) -> None:
    """Killed as soon as a release is stored: it is pending, or its objects have just been made."""
    domain = world.domain
    world.demand(goal)
    domain.wake()
    secrets = ("Secret", domain.namespace, "owner=helm")
    domain.kube.wait("a release", lambda: domain.kube.find(*secrets) or None)
    killed(world, "helm-controller")


def helm_at_uninstall(world: World, goal: dict[str, Any]) -> None:
    """Killed as soon as the Kustomization has deleted the releases."""
    sent = world.demand(goal)
    world.domain.wake()
    world.domain.wait_applied(sent.commit)
    killed(world, "helm-controller")


def kustomize(world: World, goal: dict[str, Any]) -> None:
    """Killed as soon as there is something new to apply."""
    sent = world.demand(goal)
    world.domain.wake()
    world.domain.wait_fetched(sent.commit)
    killed(world, "kustomize-controller")


def source(world: World, goal: dict[str, Any]) -> None:
    """Killed as soon as it is asked to look."""
    world.demand(goal)
    world.domain.wake()
    killed(world, "source-controller")


def generator_without_git(world: World, goal: dict[str, Any]) -> None:
    """The demand is committed and cannot be pushed; the next run finds it in the outbox."""
    before = world.tip()
    world.rig.stop_component("git")
    try:
        world.client.send(goal).hears("committed")
        world.generator.kill()
    finally:
        world.rig.start_component("git")
    assert world.tip() == before
    world.generator.start()
    world.domain.kube.wait("the push of what was in the outbox", lambda: world.tip() != before)
    world.domain.wake()


def generator_while_pushing(world: World, goal: dict[str, Any]) -> None:
    """Its `git push` outlives it and may arrive; the next run notices, the client asks again.

    What is asked again must be a demand for more: a release would find nothing left to release,
    and could make no second commit whatever the generator does.
    """
    world.rig.pause("git")
    try:
        world.client.send(goal).hears("committed")
        time.sleep(0.2)
        world.generator.kill()
    finally:
        world.rig.resume("git")
    world.generator.start()
    world.demand(goal)
    world.domain.wake()


def killed(world: World, controller: str) -> None:
    """Kill one of Flux's controllers and start it again."""
    world.rig.kill(controller)
    world.rig.start_component(controller)


KILLS: dict[int, tuple[str, Act]] = {
    1: ("helm-controller while it installs", helm_at_work),
    2: ("generator, with a commit that it could not push", generator_without_git),
    3: ("kustomize-controller while it applies", kustomize),
    4: ("generator while it pushes", generator_while_pushing),
    5: ("helm-controller while it uninstalls", helm_at_uninstall),
    6: ("kustomize-controller while it prunes", kustomize),
    7: ("source-controller while it fetches", source),
    8: ("source-controller while it fetches the last", source),
}
