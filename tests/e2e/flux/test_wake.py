"""With `--clusters` the generator triggers Flux, so a demand does not wait for the next fetch."""

from __future__ import annotations

import pytest

from tests.e2e.common import expected
from tests.e2e.common.access import access_file, limited
from tests.e2e.common.expected import CLUSTER, STEPS, WITHOUT_DEMANDS
from tests.e2e.common.world import World, show_times
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report

READ = ["get", "list", "watch"]
RIGHTS = [
    {"apiGroups": [f"{part}.toolkit.fluxcd.io"], "resources": [kind], "verbs": verbs}
    for part, kind, verbs in (
        ("source", "gitrepositories", [*READ, "patch"]),
        ("kustomize", "kustomizations", READ),
    )
]
ROUNDS = 3
"""How often the paper's eight demands are sent, one right after the other."""


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    """A state repo that Flux fetches every ten minutes; its generator may wake and watch Flux."""
    made = make_world()
    domain = made.bootstrap(CLUSTER, rig, interval="10m")
    kubeconfig = limited(rig.kube, rig.kubeconfig, made.folder, {domain.namespace: RIGHTS})
    file = access_file(made.folder, {CLUSTER: {"kubeconfig": kubeconfig}})
    made.generator.start("--clusters", str(file))
    return made


def test_a_trigger_saves_the_wait_for_the_next_fetch(world: World, say: Report) -> None:
    """Flux fetches only every ten minutes, so only the trigger can bring the demand in time."""
    times = {"joins": world.step(1, expected.after(1), wake=False)}
    show_times(say, "Triggered by the generator, next fetch after 10 minutes", times)
    world.follow(world.demand(expected.demand(1) | {"shutdown": True}), WITHOUT_DEMANDS)


def test_a_burst_of_demands_leaves_nothing(world: World) -> None:
    """A busy Flux could forget an object that it is just creating, and then never remove it."""
    for step in (*STEPS,) * ROUNDS:
        sent = world.demand(expected.demand(step))
    world.domain.wait_applied(sent.commit)
    world.domain.wait_lines(WITHOUT_DEMANDS)
