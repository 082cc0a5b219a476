"""What becomes of a cluster's file of discovered nodes, case by case."""

from datetime import datetime, timezone
from typing import Any

import pytest
from demandops.base import strict_yaml
from demandops.decide.discovery import ClusterNode, discover
from demandops.model.config import discovered
from demandops.model.config.discovered import DiscoveredNode
from demandops.model.config.inventory import Cluster

from tests.kit.plain_yaml import beside

NOW = datetime(2026, 5, 4, 12, tzinfo=timezone.utc)
CASES = beside(__file__)


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
    needed = case.get("needed", ())
    found = discover(cluster, now, before, NOW, case.get("taken", ()), lambda id: id in needed)
    assert found.path == "inventory/discovered/c-its.yaml"
    told = {"came": found.came, "left": found.left, "changed": found.changed}
    told["problems"] = found.problems
    after = strict_yaml.load(found.text)["nodes"] if found.text else None
    assert after == case.get("after")
    assert {name: [*lines] for name, lines in told.items() if lines} == {
        name: case[name] for name in told if name in case
    }
    assert found.has_gone == case.get("has_gone", False)
    known = {node["id"] for node in case.get("before", ())}
    assert {*found.new_ids} == {node["id"] for node in after or ()} - known


def test_what_was_written_is_what_is_read() -> None:
    for case in CASES:
        text = nodes(case.get("after", []))
        assert discovered.text_of(discovered.read(text, "file")) == text
