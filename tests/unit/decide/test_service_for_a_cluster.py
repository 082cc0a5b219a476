"""The scope ``cluster``: one service for all applications of a cluster that use it.

``tests/scenarios/a-service-for-a-cluster.yaml`` has a story of it.
"""

from __future__ import annotations

import re
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
from tests.kit.config import edited, skeleton
from tests.kit.memory import MemoryRepo, ledger_in

PAGE = (Path(__file__).parents[3] / "docs" / "appdef.md").read_text()
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
(EXAMPLE,) = (
    re.sub("^    ", "", found, flags=re.MULTILINE)
    for found in re.findall(r"(?:^    .*\n)+", PAGE, re.MULTILINE)
    if "scope: cluster" in found
)


def files(service: str = EXAMPLE) -> dict[str, str]:
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
    return put(demand) | {"operation": "release", "applications": []}


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


@pytest.mark.parametrize(
    ("old", "new", "field", "told"),
    [
        ("nodes: {c-its: cloud}\n", "", "", "scope 'cluster' needs 'nodes'"),
        ("scope: cluster", "scope: node", "", "no other scope may have 'nodes'"),
        ("scope: cluster", "scope: cluster\nplacement: source", "", "leave out 'placement'"),
        ("{c-its: cloud}", "{depot: cloud}", "nodes.depot", "'cloud' is in cluster 'c-its'"),
        ("{c-its: cloud}", "{c-its: clod}", "nodes.c-its", "'clod' is not in nodes.yaml"),
        ("{c-its: cloud}", "{town: cloud}", "nodes.town", "'town' is not in clusters.yaml"),
    ],
)
def test_a_definition_that_does_not_fit_is_a_fault(
    old: str, new: str, field: str, told: str
) -> None:
    assert old in EXAMPLE
    with pytest.raises(InvalidInput) as raised:
        MemoryRepo(files(EXAMPLE.replace(old, new)))
    found = raised.value.faults[0]
    assert (found.file, found.field) == ("appdefs/map-server/service.yaml", field)
    assert told in found.message
