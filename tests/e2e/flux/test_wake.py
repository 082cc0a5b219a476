"""The gain from triggering Flux: a demand with `--clusters` against one that waits for a fetch."""

from __future__ import annotations

import time

from tests.e2e.common import expected
from tests.e2e.common.access import access_file, limited
from tests.e2e.common.expected import WITHOUT_DEMANDS
from tests.e2e.common.timing import Table, Times
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import handled
from tests.e2e.rig.tools import Report

from .conftest import CLUSTER, MakeWorld
from .view import SOURCE, Domain
from .world import World

INTERVAL_S = 5.0
WAKER = {
    "apiGroups": ["source.toolkit.fluxcd.io"],
    "resources": ["gitrepositories"],
    "verbs": ["patch"],
}


def test_a_trigger_saves_the_wait_for_the_next_fetch(
    make_world: MakeWorld, rig: Rig, say: Report
) -> None:
    world = make_world()
    domain = world.bootstrap(CLUSTER, rig, interval=f"{INTERVAL_S:.0f}s")
    rights = {domain.namespace: [WAKER]}
    kubeconfig = limited(rig.kube, rig.kubeconfig, world.folder, rights)
    file = access_file(world.folder, CLUSTER, kubeconfig=kubeconfig)
    took: dict[str, Times] = {}
    for way, arguments in (("triggered", ("--clusters", str(file))), ("at the next fetch", ())):
        world.generator.start(*arguments)
        took[way] = demand_right_after_a_fetch(world, domain)
        world.follow(world.demand(expected.demand(1) | {"shutdown": True}), WITHOUT_DEMANDS)
        world.generator.stop()
    table = Table(f"Triggered by the generator and not, interval {INTERVAL_S:.0f} s")
    for way, times in took.items():
        table.add(way, times)
    table.show(say)
    say(f"  the default interval is 1m: half a minute on average, here {INTERVAL_S:.0f} s at most")
    fetch = {way: times.fetched - times.pushed for way, times in took.items()}
    assert fetch["triggered"] < INTERVAL_S / 2 < fetch["at the next fetch"]


def demand_right_after_a_fetch(world: World, domain: Domain) -> Times:
    """Send a demand when the next fetch is nearly a whole interval away."""
    token = domain.kube.reconcile("GitRepository", SOURCE, domain.namespace)
    domain.kube.wait("a fetch", lambda: handled(domain.get("GitRepository", SOURCE), token))
    time.sleep(0.1)
    return world.step(1, expected.after(1), wake=False)
