"""Two clusters follow one state repo; a test can cut the link of the vehicles' cluster."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import yaml

from tests.e2e.common import expected
from tests.e2e.common.expected import CLUSTER, NAMESPACE, NODES, VEHICLES
from tests.e2e.common.flux import SOURCE, FluxDomain
from tests.e2e.common.world import World
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report

pytestmark = pytest.mark.only("flux", "the tests count the pulls of Flux")
FLEET = "vehicles"
OTHERS = tuple(node for node in NODES if node not in VEHICLES)
CLUSTERS, INVENTORY = "inventory/clusters.yaml", "inventory/nodes.yaml"


@pytest.fixture(scope="module")
def fleet(rig: Rig, tmp_path_factory: pytest.TempPathFactory, say: Report) -> Iterator[Rig]:
    """A second cluster, for the vehicles; both clusters read the Git server of `rig`."""
    folder = tmp_path_factory.mktemp("rig")
    with Rig(FLEET, folder, nodes=VEHICLES, git_of=rig, report=say) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig, fleet: Rig) -> Iterator[World]:
    made = make_world()
    clusters = yaml.safe_load(made.file(CLUSTERS))
    clusters["clusters"].append({"name": FLEET})
    inventory = yaml.safe_load(made.file(INVENTORY))
    for node in inventory["nodes"]:
        node["cluster"] = FLEET if node["id"] in VEHICLES else CLUSTER
    made.push({CLUSTERS: yaml.safe_dump(clusters), INVENTORY: yaml.safe_dump(inventory)})
    made.generator.start()
    made.demand(expected.demand(1))  # its commit applies the inventory
    made.bootstrap(CLUSTER, rig)
    made.bootstrap(FLEET, fleet, url=fleet.git_url(made.name))
    yield made
    made.remove()  # while both clusters still run


def test_a_cluster_fetches_its_own_part_and_the_applications(world: World) -> None:
    new = "appdefs/object-detection-fusion/charts/new/README.md"  # no bootstrap file knows it
    commit = world.push({new: "a chart's\n"})
    for cluster, domain in world.domains.items():
        domain.wake()
        domain.wait_fetched(commit)
        part = f"clusters/{cluster}/{NAMESPACE}/"
        files = domain.fetched_files()
        assert {new, f"{part}_domain.yaml"} <= {*files}
        assert [file for file in files if not file.startswith((part, "appdefs/"))] == []


def test_a_cluster_that_was_cut_off_catches_up_with_one_pull(world: World, fleet: Rig) -> None:
    """The link of the vehicles' cluster is the Git server that only this cluster reads from."""
    here, there = world.domains[CLUSTER], world.domains[FLEET]
    first = world.demand(expected.demand(1))
    follow(world, first.commit, 1)
    before, pods = pulls(world, fleet), there.uids()
    fleet.parts.stop("git")
    for step in (2, 3, 4, 5, 6):
        sent = world.demand(expected.demand(step))
        for domain in (here, there):
            domain.wake()
        here.wait_lines(expected.after(step, OTHERS))
    there.kube.wait("the cut", lambda: there.trouble("GitRepository", SOURCE) or None)
    assert there.lines() == expected.after(1, VEHICLES)
    assert there.uids() == pods, "a pod was restarted during the cut"
    fleet.parts.start("git")
    there.wait_applied(sent.commit)
    there.wait_lines(expected.after(6, VEHICLES))
    assert pulls(world, fleet) == before + 1
    assert applied_since(there, first.commit) == [sent.commit]
    for step in (7, 8):
        last = world.demand(expected.demand(step))
    follow(world, last.commit, step)


def follow(world: World, commit: str, step: int) -> None:
    """Wait until both clusters have applied a commit, and have what they must after a step."""
    for domain, nodes in ((world.domains[CLUSTER], OTHERS), (world.domains[FLEET], VEHICLES)):
        domain.follow(commit)
        domain.wait_lines(expected.after(step, nodes))


def pulls(world: World, fleet: Rig) -> int:
    return fleet.parts.log("git").read_text().count(f'"POST /{world.name}/git-upload-pack ')


def applied_since(domain: FluxDomain, commit: str) -> list[str]:
    history = domain.get("Kustomization", domain.name)["status"]["history"]
    commits = [entry["metadata"]["revision"].rpartition(":")[2] for entry in history]
    return commits[: commits.index(commit)]
