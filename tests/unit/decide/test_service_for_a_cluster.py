"""The scope ``cluster``: one service for all applications of a cluster that use it."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from random import Random
from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.decide.state import rendered_files
from demandops.model.release import ServiceKey
from hypothesis import given

from tests.kit.chance import chances, examples
from tests.kit.config import edited, override, skeleton
from tests.kit.memory import MemoryRepo, ledger_in

PAGE = (Path(__file__).parents[3] / "docs" / "appdef.md").read_text()
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
(EXAMPLE,) = (
    re.sub("^    ", "", found, flags=re.MULTILINE)
    for found in re.findall(r"(?:^    .*\n)+", PAGE, re.MULTILINE)
    if "scope: cluster" in found
)


def files(service: str = EXAMPLE, **more: str) -> dict[str, str]:
    nodes = yaml.safe_load(skeleton()["inventory/nodes.yaml"])
    for node in nodes["nodes"]:
        node["cluster"] = "depot" if node["id"] in ("vehicle02", "vehicle03") else "c-its"
    clusters = yaml.safe_load(skeleton()["inventory/clusters.yaml"])
    clusters["clusters"].append({"name": "depot"})
    used = "uses: {map-server: {objects: object-fusion.fused_objects}}\ninputs:\n"
    return {
        "inventory/nodes.yaml": yaml.safe_dump(nodes),
        "inventory/clusters.yaml": yaml.safe_dump(clusters),
        "appdefs/map-server/service.yaml": service,
        "appdefs/map-server/values/map-server.yaml.j2": "replicas: {{ replicas }}\n",
        **edited(APPDEF, "inputs:\n", used),
        **more,
    }


@lru_cache(maxsize=1)
def empty() -> MemoryRepo:
    return MemoryRepo(files())


def put(demand: str, node: str = "edge", topic: str = "/ego") -> dict[str, Any]:
    inputs = {"ego_data": [{"topic": topic, "source": "vehicle00"}]}
    app = {"id": f"{node}/{demand}", "type": "object-detection-fusion", "node": node}
    made = {"kind": "Demand", "demand": demand, "requesters": [f"for-{demand}"]}
    return made | {"applications": [app | {"inputs": inputs}]}


def release(demand: str) -> dict[str, Any]:
    made = put(demand)
    return made | {"operation": "release", "applications": []}


def servers(repo: MemoryRepo) -> dict[str, list[str]]:
    """Return the applications that use each map server, by the node of the map server."""
    return {
        entry["node"]: entry["applications"]
        for entry in repo.books()["services"].values()
        if entry["service"] == "map-server"
    }


@given(chances)
@examples(12)
def test_one_runs_while_any_application_of_the_cluster_uses_it(random: Random) -> None:
    repo, held = empty().copy(), dict[str, str]()
    for _ in range(8):
        name = random.choice("abcd")
        if name in held and random.random() < 0.5:
            repo.send(release(name))
            del held[name]
        else:
            held[name] = random.choice(("edge", "cloud"))
            repo.send(put(name, held[name]))
        wanted = sorted(f"{node}/{name}" for name, node in held.items())
        assert servers(repo) == ({"cloud": wanted} if wanted else {})
        topics = [
            topic.topic
            for key, one in repo.state.plans.items()
            if isinstance(key, ServiceKey) and key.for_cluster
            for topic in one.inputs["objects"]
        ]
        assert len(topics) == len(held), "the service must read a topic of each application"
        for application in wanted:
            node = application.partition("/")[0]
            carried = repo.books()["connections"].get(f"derived/{node}/cloud", {"topics": {}})
            named = f"/{application.replace('/', '_')}_global_objectlist"
            assert named in topics
            assert (named in carried["topics"]) is (node != "cloud")
        assert ledger_in(repo.files) == repo.state.ledger
        again = rendered_files(repo.state)
        assert {path: repo.files[path] for path in again} == again
    for name in held:
        repo.send(release(name))
    assert repo.files == empty().files


def test_a_cluster_without_a_node_for_it_is_refused() -> None:
    demanded = put("a", "vehicle02")
    demanded["applications"][0]["connect"] = "none"
    assert MemoryRepo(files()).faults(demanded) == [
        "applications[0].node: 'vehicle02' is in cluster 'depot', where the application's service "
        "map-server has no node; choose a node in cluster c-its, or ask for an entry for cluster "
        "'depot' in the field nodes of appdefs/map-server/service.yaml"
    ]


def test_its_node_counts_it_and_its_rules_hold() -> None:
    domains = [
        {"name": "most", "namespace": "most", "nodes": ["vehicle*", "station*", "edge"]},
        {
            "name": "servers",
            "namespace": "servers",
            "nodes": ["cloud"],
            "rules": [{"name": "a", "requesters": ["for-a"], "peers": ["most"]}],
            "quotas": {"servicesPerNode": 1},
        },
    ]
    domains[0]["rules"] = [{"name": "all", "peers": ["servers"]}]
    head = {"apiVersion": "demandops/v1", "kind": "AccessDomains", "domains": domains}
    repo = MemoryRepo(files() | {"policy/access-domains.yaml": yaml.safe_dump(head)})
    assert repo.send(put("a")).outcome == "booked"
    assert "no rule of access domain 'servers' is for 'for-b'" in repo.faults(put("b"))[0]
    moved = put("a", "cloud")
    assert "'cloud' would run 2 services" in repo.faults(moved)[0]


PLAIN = """
apiVersion: demandops/v1
kind: ApplicationDefinition
name: plain
inputs: {ego_data: {}}
services:
  plain: {prefix: pl, inputs: {ego_data: ego_data}, chart: object-fusion, values: values/p.yaml.j2}
"""


def test_a_quota_does_not_count_it_if_all_claims_on_it_are_suspended() -> None:
    domain = {"name": "all", "namespace": "all", "quotas": {"servicesPerNode": 1}}
    head = {"apiVersion": "demandops/v1", "kind": "AccessDomains", "domains": [domain]}
    more = {
        "appdefs/plain/appdef.yaml": PLAIN,
        "appdefs/plain/values/p.yaml.j2": "replicas: 1\n",
        "policy/access-domains.yaml": yaml.safe_dump(head),
    }
    repo = MemoryRepo(files(**more))
    repo.send(put("a"))
    plain = put("b", "cloud")
    plain["applications"][0]["type"] = "plain"
    assert "'cloud' would run 2 services" in repo.faults(plain)[0]
    denied = override({"applications": ["edge/a"]}, deny=True)
    suspending = MemoryRepo(files(**more, **{"overrides/no.yaml": denied}))
    suspending.state = replace(suspending.state, ledger=repo.state.ledger)
    suspending.send(plain)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        (
            "nodes: {c-its: cloud}\n",
            "",
            "scope 'cluster' needs 'nodes' (the service's node in each cluster)",
        ),
        (
            "scope: cluster",
            "scope: node",
            "scope 'cluster' needs 'nodes' (the service's node in each cluster)",
        ),
        (
            "nodes: {c-its: cloud}",
            "nodes: {c-its: cloud}\nplacement: source",
            "with scope 'cluster' the service runs on the nodes in 'nodes'; leave out 'placement'",
        ),
        (
            "nodes: {c-its: cloud}",
            "nodes: {depot: cloud}",
            "nodes.depot: 'cloud' is in cluster 'c-its'; name a node of 'depot'",
        ),
        ("{c-its: cloud}", "{c-its: clod}", "nodes.c-its: 'clod' is not in nodes.yaml"),
        ("{c-its: cloud}", "{town: cloud}", "nodes.town: 'town' is not in clusters.yaml"),
    ],
)
def test_a_definition_that_does_not_fit_is_a_fault(old: str, new: str, fault: str) -> None:
    assert old in EXAMPLE
    with pytest.raises(InvalidInput) as raised:
        MemoryRepo(files(EXAMPLE.replace(old, new)))
    assert fault in str(raised.value)
