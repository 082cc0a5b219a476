"""Nodes that a cluster has become commits: one for all of them, and at most one a minute."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from demandops.decide.checks.collisions import all_names
from demandops.decide.checks.forbidden import whole_usage
from demandops.decide.discovery import ClusterNode
from demandops.model.config.config import Config
from demandops.serve import node_discovery
from demandops.serve.generator import Generator

from tests.kit import plain_yaml, rig
from tests.kit.cli import Run
from tests.kit.clock import Clock
from tests.kit.goals import put
from tests.kit.repo import GitRepo, Person, assert_sound, commits, git, read

FILE = "inventory/discovered/c-its.yaml"
CLUSTERS = "inventory/clusters.yaml"
POLICY = "policy/access-domains.yaml"
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


class Fleet:
    """The nodes of a cluster, by id, as a test has them."""

    def __init__(self) -> None:
        self.nodes: dict[str, ClusterNode] = {}
        self.is_known = True

    def __call__(self, config: Config) -> Mapping[str, Sequence[ClusterNode]]:
        return {"c-its": [*self.nodes.values()]} if self.is_known else {}

    def add(self, *ids: str, cordoned: bool = False, role: str = "vehicle", **more: str) -> None:
        for id in ids:
            labels = {"node_id": id, "demandops/type": role, **more}
            writers = {"": "kubectl-cordon"} if cordoned else {}
            self.nodes[id] = ClusterNode(id, labels, {"cpu": "4"}, cordoned, writers)


@pytest.fixture
def fleet() -> Fleet:
    return Fleet()


@pytest.fixture
def running(bare: Path, person: Person, fleet: Fleet, clock: Clock) -> Iterator[Generator]:
    person.change({CLUSTERS: FROM_CLUSTER})
    with rig.running(bare, runtime=clock) as generator:
        generator.take_over_nodes(fleet)
        yield generator


def listed(bare: Path) -> dict[str, Any]:
    return {node["id"]: node for node in plain_yaml.load(read(bare, FILE))["nodes"]}


def operations(bare: Path) -> list[str]:
    return [commit.one("Operation") for commit in commits(bare)]


def discoveries(bare: Path) -> int:
    return operations(bare).count("discover")


def newest(bare: Path) -> str:
    return git(bare, "log", "-1", "--format=%B", "main")


def look(running: Generator, clock: Clock) -> None:
    """Have the generator look at the nodes, a minute after the last time."""
    running.nodes_changed()
    clock.pass_(node_discovery._PAUSE_S + node_discovery._GATHER_S)
    assert rig.outcome(running.submit(put("none", node="nowhere"))) == "unknown-node"


def test_all_nodes_come_in_one_commit_and_take_demands(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock
) -> None:
    fleet.add(*(f"bus{n}" for n in range(60)))
    look(running, clock)
    assert discoveries(bare) == 1
    assert listed(bare)["bus7"] == {"id": "bus7", "type": "vehicle", "capacity": {"cpu": "4"}}
    message = newest(bare)
    assert message.startswith("Nodes of c-its: 60 came\n\nWhy: c-its said so.\n")
    assert '+ bus0: type "vehicle", capacity {"cpu": "4"}\n' in message
    assert "  and 10 more\n" in message
    assert commits(bare)[-1].all("Cluster") == ["c-its"]
    goal = put("d", "bus7", topic=("/vehicles/bus7/ego_data", "bus7"))
    assert rig.outcome(running.submit(goal)) == "booked"
    assert_sound(bare, verify_last=3)


def test_what_changes_within_a_minute_shares_a_commit(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock
) -> None:
    fleet.add("bus0", "bus1")
    look(running, clock)
    for id in ("bus0", "bus1"):
        fleet.add(id, cordoned=True)
        running.nodes_changed()
        clock.pass_(node_discovery._GATHER_S + 1)
        rig.book(running, put(id))
    assert discoveries(bare) == 1
    look(running, clock)
    assert discoveries(bare) == 2
    assert "~ bus1: cordoned by 'kubectl-cordon'\n" in newest(bare)
    # what no decision sees makes no commit, however often it changes
    for n in range(3):
        fleet.add("bus0", "bus1", cordoned=True, other=f"{n}")
        look(running, clock)
    assert discoveries(bare) == 2
    assert_sound(bare)


def test_a_node_that_is_gone_stays_until_its_claims_end(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock
) -> None:
    fleet.add("bus0", "bus1")
    look(running, clock)
    goal = put("d", "bus0", topic=("/vehicles/bus0/ego_data", "bus0"))
    rig.book(running, goal)
    fleet.nodes.clear()
    look(running, clock)
    since = {node["goneSince"] for node in listed(bare).values()}
    assert len(since) == 1
    assert running.snapshot.state.config.nodes["bus1"].drained
    # another generator goes on where this one was
    assert running.close()
    with rig.running(bare, runtime=clock) as other:
        other.take_over_nodes(fleet)
        clock.pass_(600)
        look(other, clock)
        assert [*listed(bare)] == ["bus0"]
        assert "- bus1: taken out" in newest(bare)
        rig.book(other, {"kind": "Demand", "operation": "release", "demand": "d"} | who())
        look(other, clock)
        assert listed(bare) == {}
    assert_sound(bare, verify_last=8)


def who() -> dict[str, list[str]]:
    return {"requesters": ["bus0"]}


def test_a_node_returns(running: Generator, fleet: Fleet, bare: Path, clock: Clock) -> None:
    fleet.add("bus0")
    look(running, clock)
    fleet.nodes.clear()
    look(running, clock)
    fleet.add("bus0")
    look(running, clock)
    assert "goneSince" not in listed(bare)["bus0"]
    assert "+ bus0 is back" in newest(bare)


def test_a_cordon_moves_what_was_placed(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock
) -> None:
    fleet.add("rack0", "rack1", role="rack")
    look(running, clock)
    goal = put("d")
    del goal["applications"][0]["node"]
    goal["applications"][0] |= {
        "place": {"role": "rack"},
        "connect": {"broker": "edge"},
    }
    rig.book(running, goal)
    home = running.snapshot.state.ledger.application("edge/d")
    assert home is not None
    assert home.node == "rack0"
    fleet.add("rack0", role="rack", cordoned=True)
    look(running, clock)
    moved = running.snapshot.state.ledger.application("edge/d")
    assert moved is not None
    assert moved.node == "rack1"
    assert operations(bare)[-2:] == ["discover", "drain"]
    assert_sound(bare)


def test_what_is_not_known_changes_nothing(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock
) -> None:
    fleet.add("bus0")
    look(running, clock)
    fleet.is_known = False
    look(running, clock)
    assert discoveries(bare) == 1


def test_people_cannot_edit_what_a_cluster_says(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock, person: Person
) -> None:
    fleet.add("bus0", "bus1")
    look(running, clock)
    text = read(bare, FILE)
    person.fetch()
    person.change({FILE: text.replace("bus0", "tram0"), "inventory/discovered/x.yaml": "odd"})
    running.fetch_now()
    rig.wait_until(lambda: operations(bare)[-1] == "follow", "the edit is put back")
    assert read(bare, FILE) == text
    assert "tram0" not in running.snapshot.state.config.nodes
    assert "inventory/discovered/x.yaml" not in GitRepo(bare).files()
    assert running.snapshot.faults == ()
    assert_sound(bare, verify_last=4)


def test_nothing_is_taken_over_while_an_earlier_configuration_is_in_effect(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock, person: Person
) -> None:
    fleet.add("bus0")
    look(running, clock)
    nodes = read(bare, "inventory/nodes.yaml")
    person.fetch()
    person.change({"inventory/nodes.yaml": nodes.replace("c-its", "nowhere", 1)})
    running.fetch_now()
    rig.wait_until(lambda: running.snapshot.faults, "the mistake is seen")
    fleet.add("bus1")
    look(running, clock)
    assert [*listed(bare)] == ["bus0"]
    person.fetch()
    person.change({"inventory/nodes.yaml": nodes})
    running.fetch_now()
    rig.wait_until(lambda: not running.snapshot.faults, "it is mended")
    look(running, clock)
    assert [*listed(bare)] == ["bus0", "bus1"]
    assert_sound(bare)


def test_a_listed_node_is_meant_as_it_is_listed(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock
) -> None:
    fleet.add("cloud", role="vehicle", cordoned=True)
    look(running, clock)
    assert [*listed(bare)] == ["cloud"]
    node = running.snapshot.state.config.nodes["cloud"]
    assert (node.type, node.drained) == ("cloud", False)


def test_what_people_name_stays(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock, person: Person
) -> None:
    fleet.add("bus0", "bus1")
    look(running, clock)
    brokers = "apiVersion: demandops/v1\nkind: Brokers\nbrokers: [{node: bus0, host: b.example}]\n"
    person.fetch()
    person.change({"inventory/brokers/bus.yaml": brokers})
    fleet.nodes.clear()
    look(running, clock)
    clock.pass_(600)
    look(running, clock)
    assert [*listed(bare)] == ["bus0", "bus1"]
    person.fetch()
    person.change({"inventory/brokers/bus.yaml": None})
    look(running, clock)
    assert listed(bare) == {}
    assert discoveries(bare) == 3


def test_a_cluster_whose_nodes_are_listed_again_leaves_no_file(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock, person: Person
) -> None:
    fleet.add("bus0")
    look(running, clock)
    person.fetch()
    person.edit(CLUSTERS, FROM_CLUSTER[FROM_CLUSTER.index("    nodes") :], "")
    running.fetch_now()
    look(running, clock)
    assert FILE not in GitRepo(bare).files()
    assert "bus0" not in running.snapshot.state.config.nodes
    assert_sound(bare)


def test_what_runs_is_not_planned_again(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock
) -> None:
    fleet.add("bus0", "bus1")
    look(running, clock)
    rig.book(running, put("d", "bus0", topic=("/vehicles/bus0/ego_data", "bus0")))
    before = running.snapshot.state
    names, usage = before.names(), before.usage()
    fleet.add("bus2", "bus0", role="tram")
    look(running, clock)
    state = running.snapshot.state
    assert state.config.nodes["bus0"].type == "tram"
    assert state.names() is names
    assert state.usage() is usage
    assert (names, usage) == (all_names(state), whole_usage(state))
    assert_sound(bare, verify_last=3)


def test_a_node_of_a_pattern_becomes_the_one_of_the_cluster(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock, person: Person
) -> None:
    pattern = {"id": "bus{n}", "type": "bus", "cluster": "c-its", "ros": {"domainId": 7}}
    listing = {"apiVersion": "demandops/v1", "kind": "Nodes", "nodes": [pattern]}
    person.fetch()
    person.change({"inventory/nodes/buses.yaml": json.dumps(listing)})
    running.fetch_now()
    rig.book(running, put("d", "bus0", topic=("/vehicles/bus0/ego_data", "bus0")))
    assert running.snapshot.state.config.nodes["bus0"].type == "bus"
    fleet.add("bus0", role="tram")
    look(running, clock)
    assert running.snapshot.state.config.nodes["bus0"].type == "tram"
    assert "~ " in newest(bare).partition("Desired state:")[2]
    assert_sound(bare, verify_last=3)


def test_odd_labels_leave_the_configuration_valid(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock, person: Person
) -> None:
    policy = plain_yaml.load(read(bare, POLICY))
    policy["domains"][0]["nodes"] = ["vehicle*", "station*", "edge", "cloud", "bus*"]
    policy["domains"].append(
        policy["domains"][0] | {"name": "b", "namespace": "b", "nodes": ["*9"]}
    )
    nodes = read(bare, "inventory/nodes.yaml")
    person.fetch()
    size = "  - id: cloud\n    properties: {size: 3}\n"
    listed_size = nodes.replace("  - id: cloud\n", size)
    person.change({POLICY: json.dumps(policy), "inventory/nodes.yaml": listed_size})
    fleet.add("bus1", **{"property.demandops/size": "3"})
    fleet.add("bus2", "bus3", **{"property.demandops/size": "large"})
    fleet.add("bus9")
    look(running, clock)
    config = running.snapshot.state.config
    assert running.snapshot.faults == ()
    assert [config.nodes[f"bus{n}"].properties for n in (1, 2, 3)] == [{"size": 3}, {}, {}]
    assert "bus9" in config.nodes
    assert "bus9" not in config.domain_of, "two access domains match it"
    assert_sound(bare)


def test_commands_say_who_may_change_a_discovered_node(
    running: Generator, fleet: Fleet, bare: Path, clock: Clock, tmp_path: Path, demandops: Run
) -> None:
    fleet.add("bus0")
    look(running, clock)
    ran = demandops("drain", "bus0", "--state-repo", bare)
    assert "there, run: kubectl cordon -l node_id=bus0" in ran.err
    ran = demandops("get", "nodes", "bus0", "--state-repo", bare, "--output", "json")
    assert json.loads(ran.out)["items"][0]["file"] == FILE
    ran = demandops("log", "--node", "bus0", "--state-repo", bare, "--output", "json")
    assert [entry["operation"] for entry in json.loads(ran.out)] == ["discover"]
    copy = tmp_path / "copy"
    git(tmp_path, "clone", "--quiet", str(bare), str(copy))
    (copy / FILE).write_text(read(bare, FILE).replace("bus0", "tram0"))
    ran = demandops("check", copy)
    assert f"{FILE}: is written by the generator" in ran.out + ran.err
    assert ran.code == 1
