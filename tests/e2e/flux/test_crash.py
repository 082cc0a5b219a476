"""The end state is right although a part is killed and restarted in each step of the experiment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.e2e.common import expected
from tests.e2e.common.expected import STEPS
from tests.e2e.common.world import World
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report

from .view import Domain

Act = Callable[[World, dict[str, Any]], None]


def test_eight_steps_with_a_kill_in_each(world: World, rig: Rig, say: Report) -> None:
    if rig.existing:
        pytest.skip("the tests may not kill parts of an existing cluster")
    domain = world.domain
    at_first = domain.inventory()
    for step in STEPS:
        before, start = world.tip(), time.monotonic()
        what, play = KILLS[step]
        play(world, expected.demand(step))
        domain.wait_lines(expected.after(step))
        say(f"  {step}: {what}: end state after {time.monotonic() - start:.1f} s")
        assert world.commits_since(before) == 1, "one demand must become one commit"
    domain.wait_inventory(at_first)


def kill(controller: str, reached: Callable[[Domain, str], object]) -> Act:
    """Return what demands a goal, and kills a controller once its commit has got so far."""

    def act(world: World, goal: dict[str, Any]) -> None:
        sent = world.demand(goal)
        world.domain.wake()
        reached(world.domain, sent.commit)
        world.rig.parts.kill(controller)
        world.rig.parts.start(controller)

    return act


def helm_has_stored_a_release(domain: Domain, _: str) -> None:
    """Wait for the release's secret, be the release pending or installed."""
    secrets = ("Secret", domain.namespace, "owner=helm")
    domain.kube.wait("a release", lambda: domain.kube.find(*secrets) or None)


def told_to_fetch(_: Domain, __: str) -> None:
    """Do not wait."""


def send_until_committed(world: World, goal: dict[str, Any]) -> None:
    sent = world.client.send(goal)
    world.client.wait(lambda: "committed" in sent.stages)


def generator_without_git(world: World, goal: dict[str, Any]) -> None:
    """Kill the generator while it cannot push its commit; the next generator pushes the commit."""
    before = world.tip()
    world.rig.parts.stop("git")
    try:
        send_until_committed(world, goal)
        world.generator.kill()
    finally:
        world.rig.parts.start("git")
    assert world.tip() == before
    world.generator.start()
    world.domain.kube.wait(
        "the push of what was committed before the kill", lambda: world.tip() != before
    )
    world.domain.wake()


def generator_while_pushing(world: World, goal: dict[str, Any]) -> None:
    """Kill the generator in a `git push`, then start it again and send the goal again.

    The push survives the generator and may succeed. The next generator must notice this, so that
    the repeated goal makes no second commit. The goal must be a join: a repeated shutdown never
    makes a second commit, so it would prove nothing.
    """
    world.rig.parts.pause("git")
    try:
        send_until_committed(world, goal)
        time.sleep(0.2)
        world.generator.kill()
    finally:
        world.rig.parts.resume("git")
    world.generator.start()
    world.demand(goal)
    world.domain.wake()


KILLS: dict[int, tuple[str, Act]] = {
    1: ("helm-controller while it installs", kill("helm-controller", helm_has_stored_a_release)),
    2: ("generator, with a commit that it could not push", generator_without_git),
    3: ("kustomize-controller while it applies", kill("kustomize-controller", Domain.wait_fetched)),
    4: ("generator while it pushes", generator_while_pushing),
    5: ("helm-controller while it uninstalls", kill("helm-controller", Domain.wait_applied)),
    6: ("kustomize-controller while it prunes", kill("kustomize-controller", Domain.wait_fetched)),
    7: ("source-controller while it fetches", kill("source-controller", told_to_fetch)),
    8: ("source-controller at the last commit", kill("source-controller", told_to_fetch)),
}
