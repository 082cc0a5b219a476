"""Nodes and brokers that nobody listed: one entry of the inventory stands for many.

The mistakes in such an entry are in ``config-mistakes.yaml``, and the ids for which a demand is
refused in ``tests/scenarios/nodes-by-a-pattern.yaml``.
"""

from __future__ import annotations

import json
from typing import Any

import jsonschema_rs
import yaml
from demandops.cli.authoring import schema
from demandops.decide.warnings import truth_warnings
from demandops.model.config.load import load
from demandops.render import gitops
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.config import configuration
from tests.kit.goals import put
from tests.kit.memory import MemoryRepo

NODES, BROKERS = "inventory/nodes.yaml", "inventory/brokers.yaml"
VEHICLE: dict[str, Any] = {
    "type": "vehicle",
    "cluster": "c-its",
    "topics": {"ego_data": "/vehicles/{id}/ego_data", "point_cloud": "/{id}/points_{n}"},
    "position": {"x": "{n}", "y": 7},
    "zenoh": {"endpoint": "tcp/{id}.fleet:7447"},
    "bridged": {"edge": ["/vehicles/{id}/time"]},
}
BROKER: dict[str, Any] = {"node": "vehicle{n}", "host": "{id}.fleet", "topicPrefix": "v/{n}"}


def inventory(*nodes: dict[str, Any], brokers: tuple[dict[str, Any], ...] = ()) -> dict[str, str]:
    edge = {"id": "edge", "type": "edge", "cluster": "c-its"}
    files = {
        NODES: {"kind": "Nodes", "nodes": [edge, *nodes]},
        BROKERS: {"kind": "Brokers", "brokers": [{"node": "edge", "host": "edge"}, *brokers]},
    }
    head = {"apiVersion": "demandops/v1"}
    return {path: yaml.safe_dump(head | file) for path, file in files.items()}


def filled(part: Any, n: str) -> Any:
    """Write an entry as a person would who lists the node."""
    if isinstance(part, dict):
        return {key: filled(value, n) for key, value in part.items()}
    if isinstance(part, list):
        return [filled(each, n) for each in part]
    text = part.replace("{id}", f"vehicle{n}").replace("{n}", n) if isinstance(part, str) else part
    return int(n) if part == "{n}" else text


def test_a_pattern_means_what_the_entries_would() -> None:
    listed = MemoryRepo(
        inventory(
            *({"id": f"vehicle{n}"} | filled(VEHICLE, n) for n in ("07", "8")),
            brokers=tuple(filled(BROKER, n) for n in ("07", "8")),
        )
    )
    pattern = MemoryRepo(inventory({"id": "vehicle{n}"} | VEHICLE, brokers=(BROKER,)))
    for node in ("vehicle07", "vehicle8"):
        for repo in (listed, pattern):
            repo.send(put(node, node, id="fusion", topic=(f"/vehicles/{node}/ego_data", node)))
        for known in (lambda config: config.nodes, lambda config: config.brokers):
            assert known(listed.config)[node] == known(pattern.config)[node]
    differing = {*listed.files.items()} ^ {*pattern.files.items()}
    assert {path for path, _ in differing} == {NODES, BROKERS}


def test_an_editor_accepts_placeholders_in_place_of_any_value() -> None:
    files = inventory({"id": "vehicle{n}"} | VEHICLE, brokers=({**BROKER, "port": "{n}"},))
    for path, name in ((NODES, "nodes"), (BROKERS, "brokers")):
        validator = jsonschema_rs.validator_for(json.loads(schema.text(name)))
        assert [error.message for error in validator.iter_errors(yaml.safe_load(files[path]))] == []
        wrong = files[path].replace("'{n}'", "'n'")
        assert wrong != files[path]
        assert [*validator.iter_errors(yaml.safe_load(wrong))]


def test_a_placeholder_is_no_word_of_yaml() -> None:
    files = inventory({"id": "vehicle{n}", "topics": {"a": "/{n}/{y}"}})
    assert [*truth_warnings(files)] == []
    assert len([*truth_warnings({NODES: "b: [{y}]\nc: { off }"})]) == 2


def test_a_listed_node_goes_before_a_pattern() -> None:
    own = {"id": "vehicle7", "type": "bus", "cluster": "c-its"}
    config = load(configuration(inventory({"id": "vehicle{n}"} | VEHICLE, own)))
    assert (config.nodes["vehicle7"].type, config.nodes["vehicle8"].type) == ("bus", "vehicle")


@given(st.text(alphabet="{}n$ab-*?[/@.", max_size=12))
@examples(200)
def test_any_id_is_one_node_or_none(id: str) -> None:
    entries = [{"id": f"{p}{{n}}", "type": "vehicle", "cluster": "c-its"} for p in "abn"]
    config = load(configuration(inventory(*entries)))
    node = config.nodes.get(id)
    assert (id in config.nodes) is (node is not None)
    assert node is None or (node.id == id and config.domain_of[id] is not None)


def test_an_id_of_any_length_is_refused_as_what_it_is() -> None:
    repo = MemoryRepo(inventory({"id": "vehicle{n}"} | VEHICLE))
    for id in (f"vehicle{'9' * 5000}", "@" * 1000, "a@" * 5000):
        faults = repo.faults(put("d", id, id="fusion", topic=("/ego", id)))
        assert any("is not in inventory/nodes.yaml" in told for told in faults), faults


def test_a_pattern_has_its_namespaces_and_its_part_of_the_rule_of_its_cluster() -> None:
    own_label = {"id": "bus{n}", "type": "bus", "cluster": "c-its", "selector": {"vin": "b.{n}"}}
    config = load(configuration(inventory({"id": "vehicle{n}"} | VEHICLE, own_label)))
    ((cluster, domain),) = gitops.domains_in_use(config)
    rule = gitops.node_rule(cluster, domain, config)
    assert '("vin" in variables.selector && variables.selector["vin"].matches("^b\\\\.[A-Z' in rule


def test_a_node_of_many_patterns_is_found_among_few() -> None:
    entries = [{"id": f"fleet{i}-{{n}}", "type": "car", "cluster": "c-its"} for i in range(3000)]
    config = load(configuration(inventory(*entries)))
    assert [*config.unlisted.patterns.candidates("fleet77-5")] == [
        config.node_patterns["fleet77-{n}"]
    ]
