"""What becomes of a cluster's file of discovered nodes, case by case."""

import json
from datetime import datetime, timezone
from typing import Any

import pytest
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput
from demandops.decide.discovery import ClusterNode, discover
from demandops.decide.state import State
from demandops.decide.warnings import policy_warnings
from demandops.model.config import discovered
from demandops.model.config.discovered import DiscoveredNode
from demandops.model.config.inventory import Cluster
from demandops.model.config.load import load
from demandops.model.ledger.ledger import Ledger
from demandops.templating.evaluator import EVALUATE
from hypothesis import given
from hypothesis import strategies as st

from tests.kit import plain_yaml
from tests.kit.chance import examples
from tests.kit.config import configuration, edited, skeleton

FROM_CLUSTER = """\
apiVersion: demandops/v1
kind: Clusters
clusters: [{name: c-its, nodes: from-cluster}]
"""
NOW = datetime(2026, 5, 4, 12, tzinfo=timezone.utc)
PATH = "inventory/discovered/c-its.yaml"
POLICY = "policy/access-domains.yaml"
CASES = plain_yaml.beside(__file__)


def nodes(written: list[dict[str, Any]]) -> str:
    return discovered.text_of(DiscoveredNode.model_validate(node) for node in written)


def seen(name: str, node: dict[str, Any]) -> ClusterNode:
    allocatable, writers = node.get("allocatable", {}), node.get("writers", {})
    is_cordoned = node.get("cordoned", False)
    return ClusterNode(node.get("name", name), node["labels"], allocatable, is_cordoned, writers)


@pytest.mark.parametrize("case", CASES, ids=[case["is"] for case in CASES])
def test_a_file_follows_its_cluster(case: dict[str, Any]) -> None:
    how = {"nodes": "from-cluster", "discovery": case.get("how", {})}
    cluster = Cluster.model_validate({"name": "c-its", **how})
    before = nodes(case["before"]) if "before" in case else None
    now = [seen(f"machine-{n}", node) for n, node in enumerate(case.get("seen", ()))]
    needed, files, unfit = (case.get(name, {}) for name in ("needed", "files", "unfit"))
    found = discover(cluster, now, before, NOW, files, unfit, lambda id: id in needed)
    assert found.path == PATH
    assert not found.text or discovered.text_of(discovered.read(found.text, PATH)) == found.text
    told = {w: getattr(found, w) for w in ("came", "gone", "left", "changed", "problems")}
    after = strict_yaml.load(found.text)["nodes"] if found.text else None
    assert after == case.get("after")
    assert {name: [*lines] for name, lines in told.items() if lines} == {
        name: case[name] for name in told if name in case
    }
    assert found.has_gone == case.get("has_gone", False)
    known = {node["id"] for node in case.get("before", ())}
    assert {*found.new_ids} == {node["id"] for node in after or ()} - known


def test_labels_add_to_what_each_node_has() -> None:
    entry = {"capabilities": ["gpu"], "properties": {"size": 1, "doors": 2}, "capacity": {"gpu": 1}}
    how = f", discovery: {{entry: {json.dumps(entry)}}}}}]"
    clusters = FROM_CLUSTER.replace("}]", how)
    own = {"capabilities": ["lidar"], "properties": {"size": 3}}
    own["capacity"] = {"cpu": "4", "nvidia.com/gpu": "2"}
    files = {"inventory/clusters.yaml": clusters, PATH: nodes([{"id": "bus0", **own}])}
    node = load(configuration(files)).nodes["bus0"]
    assert node.capabilities == ("gpu", "lidar")
    assert node.properties == {"size": 3, "doors": 2}
    assert node.capacity == {"cpu": "4", "gpu": "2"}, "two names of one resource"


def test_the_faults_of_an_edited_file_are_told_there() -> None:
    odd = nodes([{"id": "bus0", "type": "bus"}]).replace("type: bus", "type: -x")
    with pytest.raises(InvalidInput) as error:
        load(configuration({"inventory/clusters.yaml": FROM_CLUSTER, PATH: odd}))
    assert [(each.file, each.field) for each in error.value.faults] == [(PATH, "nodes[0].type")]


odd = ["1", "true", "gpu", "0.5", "4Gi", "a..b", "é", "a b", "a/b", "a@b", "-a", "{n}", "x" * 64]
anything = st.text(max_size=9) | st.sampled_from(odd)
known = st.sampled_from(
    ["demandops/type", "capability.demandops/gpu", "cpu", "property.demandops/size"]
)
keys = known | st.builds(str.__add__, st.sampled_from(["", "property.demandops/"]), anything)
texts = st.dictionaries(keys, anything, max_size=5)


@st.composite
def cluster_nodes(draw: st.DrawFn) -> list[ClusterNode]:
    ids = draw(st.lists(st.sampled_from(["bus0", "bus1", "cloud"]) | anything, max_size=4))
    return [
        ClusterNode(f"m{n}", {**draw(texts), "node_id": id}, draw(texts), draw(st.booleans()), {})
        for n, id in enumerate(ids)
    ]


@given(cluster_nodes(), cluster_nodes())
@examples(150)
def test_whatever_a_cluster_says_the_configuration_stays_valid(
    first: list[ClusterNode], second: list[ClusterNode]
) -> None:
    cluster = Cluster.model_validate({"name": "c-its", "nodes": "from-cluster"})
    text = None
    for seen in (first, second):
        found = discover(cluster, seen, text, NOW, {}, {}, lambda id: False)
        text = found.text
        config = load(configuration({"inventory/clusters.yaml": FROM_CLUSTER, found.path: text}))
        cloud = config.nodes["cloud"]
        assert (cloud.type, cloud.drained) == ("cloud", False), "as it is listed"
        again = discover(cluster, seen, text, NOW, {}, {}, lambda id: False)
        assert (again.text, again.came, again.gone, again.changed) == (text, (), (), ())


def test_values_and_nodes_that_contradict_other_files_do_not_count() -> None:
    sizes = {"bus1": 3, "bus2": "large", "bus3": "large"}
    found = [{"id": id, "properties": {"size": size, "doors": size}} for id, size in sizes.items()]
    file = nodes([*found, {"id": "bus9"}])
    size = ("- id: cloud\n", "- id: cloud\n    properties: {size: 3}\n")
    doors = ("prefix: of\n", "prefix: of\n    place: {properties: {doors: {min: 2}}}\n")
    changed = edited("inventory/nodes.yaml", *size) | {"inventory/clusters.yaml": FROM_CLUSTER}
    changed |= edited("appdefs/object-detection-fusion/appdef.yaml", *doors)
    policy = plain_yaml.load(skeleton()[POLICY])
    policy["domains"][0]["nodes"] = ["vehicle*", "station*", "edge", "cloud", "bus*"]
    policy["domains"].append(
        {"name": "b", "namespace": "b", "serviceAccount": "b", "nodes": ["*9"]}
    )
    changed |= {POLICY: json.dumps(policy), PATH: file}
    config = load(configuration(changed))
    assert [config.nodes[id].properties for id in sizes] == [{"size": 3, "doors": 3}, {}, {}]
    assert "bus9" in config.nodes
    assert "bus9" not in config.domain_of, "two access domains match it"
    told = "'bus9' is in the access domains 'b' by '*9' and 'perception' by 'bus*'; narrow these "
    (warning,) = policy_warnings(State(config, Ledger(), EVALUATE))
    assert str(warning).startswith(f"{POLICY}: {told}")
