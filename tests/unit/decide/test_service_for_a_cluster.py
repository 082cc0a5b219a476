"""The scope ``cluster``: one service for all applications of a cluster that use it.

``tests/scenarios/a-service-for-a-cluster.yaml`` has a story of it.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.model.release import ServiceKey

from tests.kit.config import edited, skeleton
from tests.kit.goals import put
from tests.kit.memory import MemoryRepo

EXAMPLE = (Path(__file__).parents[3] / "examples" / "map-server" / "service.yaml").read_text()
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"


def files(service: str) -> dict[str, str]:
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


def test_the_example_of_the_page_reads_the_objects_of_all_applications() -> None:
    repo = MemoryRepo(files(EXAMPLE))

    def read() -> list[list[str]]:
        plans = repo.state.plans.items()
        servers = (one for key, one in plans if isinstance(key, ServiceKey) and key.for_cluster)
        return [sorted(topic.topic for topic in one.inputs["objects"]) for one in servers]

    repo.send(put("a", node="edge"))
    repo.send(put("b", node="cloud"))
    assert read() == [["/edge_a_global_objectlist", "/edge_b_global_objectlist"]]
    carried = repo.books()["connections"]
    assert "derived/edge/cloud/edge_a_global_objectlist" in carried
    repo.send(put("b", operation="release", applications=[]))
    assert read() == [["/edge_a_global_objectlist"]]
    repo.send(put("a", operation="release", applications=[]))
    assert repo.rendered() == {}


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
