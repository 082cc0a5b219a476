"""With `--clusters` the generator triggers Flux, so a demand does not wait for the next fetch."""

from __future__ import annotations

from tests.e2e.common import expected
from tests.e2e.common.access import access_file, limited
from tests.e2e.common.expected import CLUSTER, WITHOUT_DEMANDS
from tests.e2e.common.timing import Table
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report

from .conftest import MakeWorld

WAKER = {
    "apiGroups": ["source.toolkit.fluxcd.io"],
    "resources": ["gitrepositories"],
    "verbs": ["patch"],
}


def test_a_trigger_saves_the_wait_for_the_next_fetch(
    make_world: MakeWorld, rig: Rig, say: Report
) -> None:
    """Flux fetches only every ten minutes, so only the trigger can bring the demand in time."""
    world = make_world()
    domain = world.bootstrap(CLUSTER, rig, interval="10m")
    rights = {domain.namespace: [WAKER]}
    kubeconfig = limited(rig.kube, rig.kubeconfig, world.folder, rights)
    file = access_file(world.folder, CLUSTER, kubeconfig=kubeconfig)
    world.generator.start("--clusters", str(file))
    table = Table("Triggered by the generator, next fetch after 10 minutes")
    table.add("joins", world.step(1, expected.after(1), wake=False))
    table.show(say)
    world.follow(world.demand(expected.demand(1) | {"shutdown": True}), WITHOUT_DEMANDS)
