"""Nodes that a cluster has become commits: one for all of them, and at most one a minute."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pygit2
import pytest
from demandops.decide.checks.collisions import all_names
from demandops.decide.checks.forbidden import whole_usage
from demandops.decide.discovery import ClusterNode
from demandops.decide.state import State
from demandops.model.config.config import Config
from demandops.repo.load.snapshot import follow
from demandops.serve import node_discovery
from demandops.serve.generator import Generator

from tests.kit import plain_yaml, rig
from tests.kit.clock import Clock
from tests.kit.goals import put
from tests.kit.memory import NOW
from tests.kit.repo import GitRepo, Person, assert_sound, commits, git, read, tip

FILE = "inventory/discovered/c-its.yaml"
CLUSTERS = "inventory/clusters.yaml"
FROM_CLUSTER = """\
apiVersion: demandops/v1
kind: Clusters
clusters:
  - name: c-its
    nodes: from-cluster
    discovery:
      entry:
        topics: {ego_data: "/vehicles/{id}/ego_data"}
"""


class Cluster:
    """A cluster's nodes, by id, as a test has them, and a generator that takes them over."""

    def __init__(self, bare: Path, clock: Clock) -> None:
        self._bare, self._clock = bare, clock
        self.nodes: dict[str, ClusterNode] = {}
        self.of_other: dict[str, ClusterNode] = {}
        self.is_known = True

    def __call__(self, config: Config) -> Mapping[str, Sequence[ClusterNode]]:
        known = {"c-its": [*self.nodes.values()], "other": [*self.of_other.values()]}
        return {name: known[name] for name in config.clusters if self.is_known}

    def add(self, *ids: str, cordoned: bool = False, role: str = "vehicle", **more: str) -> None:
        for id in ids:
            labels = {"node_id": id, "demandops/type": role, **more}
            writers = {"": "kubectl-cordon"} if cordoned else {}
            self.nodes[id] = ClusterNode(id, labels, {"cpu": "4"}, cordoned, writers)

    def serve(self, generator: Generator) -> None:
        self.generator = generator
        generator.take_over_nodes(self)

    def change(self, after_s: float) -> None:
        """Have the cluster say that its nodes changed, and let time pass."""
        self.generator.nodes_changed()
        self.wait(after_s)

    def wait(self, after_s: float) -> None:
        self._clock.pass_(after_s)
        assert rig.outcome(self.generator.submit(put("none", node="nowhere"))) == "unknown-node"

    def look(self) -> None:
        """Have the generator look at the nodes, a minute after the last time, as main is now."""
        self.generator.fetch_now()
        rig.wait_until(
            lambda: str(self.generator.snapshot.commit) == str(tip(self._bare)), "it is at main"
        )
        self.change(node_discovery._PAUSE_S + node_discovery._GATHER_S)

    @property
    def state(self) -> State:
        return self.generator.snapshot.state

    @property
    def listed(self) -> dict[str, Any]:
        return {node["id"]: node for node in plain_yaml.load(read(self._bare, FILE))["nodes"]}

    @property
    def operations(self) -> list[str]:
        return [commit.one("Operation") for commit in commits(self._bare)]

    @property
    def discoveries(self) -> int:
        return self.operations.count("discover")

    @property
    def newest(self) -> str:
        return git(self._bare, "log", "-1", "--format=%B", "main")

    def book(self, id: str) -> None:
        goal = put("d", id, topic=(f"/vehicles/{id}/ego_data", id))
        assert [receipt.outcome for receipt in rig.book(self.generator, goal)] == ["booked"]


@pytest.fixture
def cluster(
    bare: Path, person: Person, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Cluster]:
    monkeypatch.setattr(node_discovery, "_PAUSE_S", 600.0)  # longer than a slow test takes
    person.change({CLUSTERS: FROM_CLUSTER})
    cluster = Cluster(bare, clock)
    with rig.running(bare, runtime=clock) as generator:
        cluster.serve(generator)
        yield cluster


def test_all_nodes_come_in_one_commit_and_take_demands(cluster: Cluster, bare: Path) -> None:
    cluster.add(*(f"bus{n}" for n in range(60)), "bus-60")  # no topic may have this name
    cluster.look()
    assert cluster.discoveries == 1
    assert "bus-60" not in cluster.listed
    assert cluster.listed["bus7"] == {"id": "bus7", "type": "vehicle", "capacity": {"cpu": "4"}}
    message = cluster.newest
    assert message.startswith("Nodes of c-its: 60 came\n\nWhy: c-its said so.\n")
    assert '+ bus0: type "vehicle", capacity {"cpu": "4"}\n' in message
    assert "  and 10 more\n" in message
    assert commits(bare)[-1].all("Cluster") == ["c-its"]
    cluster.book("bus7")
    assert_sound(bare, verify_last=3)


def test_what_changes_within_a_minute_shares_a_commit(cluster: Cluster, bare: Path) -> None:
    cluster.add("bus0", "bus1")
    cluster.look()
    for id in ("bus0", "bus1"):
        cluster.add(id, cordoned=True)
        cluster.change(node_discovery._GATHER_S + 1)
    assert cluster.discoveries == 1
    cluster.look()
    assert cluster.discoveries == 2
    assert "~ bus1: cordoned by 'kubectl-cordon'\n" in cluster.newest
    # what no decision sees makes no commit, however often it changes
    for n in range(3):
        cluster.add("bus0", "bus1", cordoned=True, other=f"{n}")
        cluster.look()
    cluster.is_known = False  # it cannot be reached
    cluster.nodes.clear()
    cluster.look()
    assert cluster.discoveries == 2
    assert_sound(bare)


def test_a_node_moves_to_another_cluster_when_it_has_left_the_first(
    cluster: Cluster, bare: Path, person: Person, clock: Clock
) -> None:
    person.change({CLUSTERS: f"{FROM_CLUSTER}  - {{name: other, nodes: from-cluster}}\n"})
    cluster.add("bus0")
    cluster.of_other |= cluster.nodes  # both are new, but only one can be the node
    cluster.look()
    assert git(bare, "grep", "-l", "bus0", "main", "--", "inventory/discovered").split() == [
        f"main:{FILE}"
    ]
    cluster.nodes.clear()
    cluster.look()
    clock.pass_(600)
    cluster.look()
    assert cluster.listed == {}
    cluster.wait(node_discovery._PAUSE_S)
    assert cluster.state.config.nodes["bus0"].cluster == "other"
    assert_sound(bare)


def test_people_cannot_edit_what_a_cluster_says(
    cluster: Cluster, bare: Path, person: Person
) -> None:
    cluster.add("bus0", "bus1")
    cluster.look()
    text = read(bare, FILE)
    objects = pygit2.Repository(bare)
    for edited in (text.replace("bus0", "tram0"), "odd"):
        seen = cluster.generator.snapshot
        # who only reads sees none of it, not even after a second commit
        for path in (FILE, "inventory/discovered/x.yaml"):
            commit = pygit2.Oid(hex=person.change({path: edited}))
            seen = follow(objects, seen, commit, NOW).snapshot
            assert {"bus0", "tram0"} & {*seen.state.config.nodes} == {"bus0"}
        cluster.generator.fetch_now()
        rig.wait_until(lambda: cluster.operations[-1] == "follow", "the edit is put back")
        told = f"Put back, because not valid:\n  {FILE}: is written only by"
        assert told in git(bare, "log", "-4", "--format=%B", "main")
        assert read(bare, FILE) == text
        assert "inventory/discovered/x.yaml" not in GitRepo(bare).files()
        assert cluster.generator.snapshot.faults == ()
    assert_sound(bare, verify_last=4)


def test_nothing_is_taken_over_while_an_earlier_configuration_is_in_effect(
    cluster: Cluster, bare: Path, person: Person
) -> None:
    cluster.add("bus0")
    cluster.look()
    person.edit("inventory/nodes.yaml", "cluster: c-its", "cluster: nowhere")
    cluster.generator.fetch_now()
    rig.wait_until(lambda: cluster.generator.snapshot.faults, "the mistake is seen")
    cluster.add("bus1")
    cluster.look()
    assert [*cluster.listed] == ["bus0"]
    person.edit("inventory/nodes.yaml", "cluster: nowhere", "cluster: c-its")
    cluster.generator.fetch_now()
    rig.wait_until(lambda: not cluster.generator.snapshot.faults, "it is mended")
    cluster.look()
    assert [*cluster.listed] == ["bus0", "bus1"]
    assert_sound(bare)


def test_what_people_name_stays(cluster: Cluster, person: Person, clock: Clock) -> None:
    cluster.add("bus0", "bus1")
    cluster.look()
    brokers = "apiVersion: demandops/v1\nkind: Brokers\nbrokers: [{node: bus0, host: b.example}]\n"
    person.change({"inventory/brokers/bus.yaml": brokers})
    cluster.nodes.clear()
    cluster.look()
    assert cluster.state.config.nodes["bus1"].drained, "it is gone"
    assert cluster.newest.startswith("Nodes of c-its: 2 gone\n")
    clock.pass_(600)
    cluster.look()
    assert [*cluster.listed] == ["bus0", "bus1"]
    person.change({"inventory/brokers/bus.yaml": None})
    cluster.look()
    assert cluster.listed == {}
    assert cluster.discoveries == 3


def test_a_cluster_whose_nodes_are_listed_again_leaves_no_file(
    cluster: Cluster, bare: Path, person: Person
) -> None:
    cluster.add("bus0")
    cluster.look()
    person.edit(CLUSTERS, FROM_CLUSTER[FROM_CLUSTER.index("    nodes") :], "")
    cluster.look()
    assert FILE not in GitRepo(bare).files()
    assert "bus0" not in cluster.state.config.nodes
    assert_sound(bare)


def test_what_runs_is_not_planned_again(cluster: Cluster, bare: Path) -> None:
    cluster.add("bus0", "bus1")
    cluster.look()
    cluster.book("bus0")
    names, usage = cluster.state.names, cluster.state.usage
    cluster.add("bus2", "bus0", role="tram")
    cluster.look()
    state = cluster.state
    assert state.config.nodes["bus0"].type == "tram"
    assert state.names is names
    assert state.usage is usage
    assert (names, usage) == (all_names(state), whole_usage(state))
    assert_sound(bare, verify_last=3)


def test_a_node_of_a_pattern_becomes_the_one_of_the_cluster(
    cluster: Cluster, bare: Path, person: Person
) -> None:
    pattern = {"id": "bus{n}", "type": "bus", "cluster": "c-its", "ros": {"domainId": 7}}
    listing = {"apiVersion": "demandops/v1", "kind": "Nodes", "nodes": [pattern]}
    person.change({"inventory/nodes/buses.yaml": json.dumps(listing)})
    cluster.generator.fetch_now()
    cluster.book("bus0")
    assert cluster.state.config.nodes["bus0"].type == "bus"
    cluster.add("bus0", "bus1", role="tram")
    cluster.look()
    assert {cluster.state.config.nodes[id].type for id in ("bus0", "bus1")} == {"tram"}
    assert "~ " in cluster.newest.partition("Desired state:")[2]
    assert_sound(bare, verify_last=3)
