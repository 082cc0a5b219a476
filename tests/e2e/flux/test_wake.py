"""What waking Flux is worth: a demand with `--clusters`, and one that waits for the next look."""

from __future__ import annotations

import time

from tests.e2e.common import expected
from tests.e2e.common.access import access_file, limited
from tests.e2e.common.expected import STANDING
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


def test_a_wake_saves_the_wait_for_the_next_look(
    make_world: MakeWorld, rig: Rig, say: Report
) -> None:
    world = make_world()
    domain = world.bootstrap(CLUSTER, rig, interval=f"{INTERVAL_S:.0f}s")
    rights = {domain.namespace: [WAKER]}
    kubeconfig = limited(rig.kube, rig.kubeconfig, world.folder, rights)
    file = access_file(world.folder, CLUSTER, kubeconfig=kubeconfig)
    took: dict[str, Times] = {}
    for way, arguments in (("woken", ("--clusters", str(file))), ("at the next look", ())):
        world.generator.start(*arguments)
        took[way] = demanded_right_after_a_look(world, domain)
        world.follow(world.demand(expected.demand(1) | {"shutdown": True}), STANDING)
        world.generator.stop()
    table = Table(f"Woken by the generator and not, interval {INTERVAL_S:.0f} s")
    for way, times in took.items():
        table.add(way, times)
    table.show(say)
    say(f"  the default interval is 1m: half a minute on average, here {INTERVAL_S:.0f} s at most")
    fetch = {way: times.fetched - times.pushed for way, times in took.items()}
    assert fetch["woken"] < INTERVAL_S / 2 < fetch["at the next look"]


def demanded_right_after_a_look(world: World, domain: Domain) -> Times:
    """Send a demand when the next look is nearly a whole interval away."""
    token = domain.kube.reconcile("GitRepository", SOURCE, domain.namespace)
    domain.kube.wait("a look", lambda: handled(domain.get("GitRepository", SOURCE), token))
    time.sleep(0.1)
    return world.step(1, expected.after(1), wake=False)
