"""One entry of the inventory may stand for many nodes and brokers, and a collection for many files.

The mistakes in such an entry are in ``config-mistakes.yaml``, and the ids for which a demand is
refused in ``tests/scenarios/nodes-by-a-pattern.yaml``. Examples come from docs/inventory.md.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import jsonschema_rs
import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.cli.authoring import schema
from demandops.decide.warnings import truth_warnings
from demandops.model.config.config import (
    CLIENTS_FILE,
    COLLECTIONS,
    NODES_FILE,
    collection_of,
)
from demandops.model.config.load import load
from demandops.render import gitops
from hypothesis import given
from hypothesis import strategies as st

from tests.kit import forms, plain_yaml
from tests.kit.chance import examples
from tests.kit.config import configuration, edited, skeleton
from tests.kit.goals import put
from tests.kit.memory import MemoryRepo

NODES, BROKERS = "inventory/nodes.yaml", "inventory/brokers.yaml"
POLICY = "policy/access-domains.yaml"
PATTERNS = plain_yaml.beside(__file__, "patterns")
VEHICLE, BROKER = PATTERNS["vehicle"], PATTERNS["broker"]
FURTHER = {"accessDomains": [{"name": "b"}]}


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


def two_domains() -> dict[str, str]:
    """Return a policy with a further domain, of which only the first one has a ROS domain."""
    policy = yaml.safe_load(skeleton()[POLICY])
    policy["domains"][0]["ros"] = {"domainId": 7}
    policy["domains"].append({"name": "b", "namespace": "b", "nodes": []})
    return {POLICY: json.dumps(policy)}


def test_a_pattern_means_what_the_entries_would() -> None:
    vehicle = VEHICLE | FURTHER
    entries = [{"id": f"vehicle{n}"} | filled(vehicle, n) for n in ("07", "8")]
    brokers = tuple(filled(BROKER, n) for n in ("07", "8"))
    listed = MemoryRepo(inventory(*entries, brokers=brokers) | two_domains())
    written = inventory({"id": "vehicle{n}"} | vehicle, brokers=(BROKER,))
    pattern = MemoryRepo(written | two_domains())
    for node in ("vehicle07", "vehicle8"):
        assert listed.config.nodes[f"{node}@b"] == pattern.config.nodes[f"{node}@b"]
        for repo in (listed, pattern):
            repo.send(put(node, node, id="fusion", topic=(f"/vehicles/{node}/ego_data", node)))
        for known in (lambda config: config.nodes, lambda config: config.brokers):
            assert known(listed.config)[node] == known(pattern.config)[node]
    differing = {*listed.files.items()} ^ {*pattern.files.items()}
    # the bootstrap names the listed vehicles of the further domain, or their pattern
    assert {path for path, _ in differing} == {NODES, BROKERS, gitops.bootstrap_path("c-its")}


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
    repo = MemoryRepo(inventory({"id": "vehicle{n}_{a}{b}x"} | VEHICLE))
    for id in (f"vehicle{'9' * 5000}", "@" * 1000, "a@" * 5000, f"vehicle{'_' * 1000}/x"):
        faults = repo.faults(put("d", id, id="fusion", topic=("/ego", id)))
        assert any("is not in inventory/nodes.yaml" in told for told in faults), faults


def test_a_pattern_has_its_namespaces_and_its_part_of_the_rule_of_its_cluster() -> None:
    own_label = {"id": "bus{n}", "type": "bus", "cluster": "c-its", "selector": {"vin": "b.{n}"}}
    config = load(configuration(inventory({"id": "vehicle{n}"} | VEHICLE, own_label)))
    ((cluster, (domain,)),) = gitops.domains_by_cluster(config).items()
    rule = gitops.node_rule(cluster, domain, config)
    assert '("vin" in variables.selector && variables.selector["vin"].matches("^b\\\\.[A-Z' in rule
    tram = {"id": "tram{n}", "type": "tram", "cluster": "c-its"} | FURTHER
    config = load(configuration(inventory(tram) | two_domains()))
    ((cluster, (domain, _)),) = gitops.domains_by_cluster(config).items()
    assert '["node_id"].matches("^tram[A-Z' in gitops.node_rule(cluster, domain, config)


def test_a_node_of_many_patterns_is_found_among_few() -> None:
    entries = [{"id": f"fleet{i}-{{n}}", "type": "car", "cluster": "c-its"} for i in range(3000)]
    config = load(configuration(inventory(*entries)))
    assert config.node_patterns.matching("fleet77-5") == [config.node_patterns["fleet77-{n}"]]


# ---- a collection is in one file or in many, without any difference for entries and faults ----


PAGE = (Path(__file__).parents[3] / "docs" / "inventory.md").read_text()
BLOCKS = re.findall(r"```\w+\n(.*?)```", PAGE, re.DOTALL)
FILES = {
    title.removeprefix("# "): text
    for title, _, text in (block.partition("\n") for block in BLOCKS)
    if title.startswith("# ")
}
NEW_VEHICLE, ROADSIDE = "inventory/nodes/vehicle07.yaml", "inventory/nodes/roadside.yaml"


def faults(changed: Mapping[str, str | None]) -> str:
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(changed))
    return f"{invalid.value}\n"


def split(files: Mapping[str, str], random: Random) -> dict[str, str]:
    """Move random entries of each collection to other files in the collection's folder."""
    result = dict(files)
    for path in {*COLLECTIONS} & {*files}:
        data, parts = plain_yaml.load(result.pop(path)), dict[str, dict[str, Any]]()
        heads = ("apiVersion", "kind", "registry")
        head = {name: data.pop(name) for name in heads if name in data}
        for name, entries in data.items():
            for key in entries if isinstance(entries, dict) else range(len(entries)):
                # the settings of a connection type must stay in one file
                if path != CLIENTS_FILE or key == next(iter(entries)):
                    place = path.replace(".yaml", random.choice([".yaml", "/a.yaml", "/b.yaml"]))
                part = parts.setdefault(place, dict(head))
                if isinstance(entries, dict):
                    part.setdefault(name, {})[key] = entries[key]
                else:
                    part.setdefault(name, []).append(entries[key])
        result |= {place: yaml.safe_dump(part) for place, part in parts.items()}
    return result


@pytest.mark.parametrize("seed", range(20))
def test_entries_count_wherever_they_are(seed: int) -> None:
    files = forms.rich() if seed % 2 else configuration()
    spread = split(files, Random(seed))
    assert {path for path in spread if collection_of(path) not in (None, path)}
    whole, parts = load(files), load(spread)
    assert parts == whole
    for collection, entries in parts.entry_files.items():
        assert entries.keys() == whole.entry_files[collection].keys()


def test_the_examples_of_the_documentation_join_the_fleet() -> None:
    config = load(configuration(FILES))
    assert {"vehicle07", "vehicle00"} <= config.nodes.keys()
    assert config.file_of(NODES_FILE, "vehicle07") == NEW_VEHICLE
    assert config.file_of(NODES_FILE, "vehicle00") == NODES_FILE


def test_the_faults_of_the_documentation_are_told() -> None:
    head, more = (
        FILES[NEW_VEHICLE].partition("  - id")[0],
        "  - {{id: {}, type: edge, cluster: c-its}}\n",
    )
    twice = head + more.format("station01") + more.format("vehicle07")
    assert faults(FILES | {ROADSIDE: twice}) in BLOCKS
    unread = faults({"inventory/vehicles.yaml": FILES[NEW_VEHICLE]})
    assert unread.startswith("inventory/vehicles.yaml: is not read; only <name>.yaml and <name>/")


def test_the_folder_alone_is_enough_and_messages_name_it() -> None:
    moved = {NODES_FILE: None, "inventory/nodes/all.yaml": skeleton()[NODES_FILE]}
    assert MemoryRepo(moved).config == load(configuration())
    broker = edited("inventory/brokers.yaml", "node: cloud", "node: clod")
    assert "brokers[0].node: 'clod' is not in nodes/; did you mean" in faults(moved | broker)
    assert faults({NODES_FILE: None}).startswith(f"{NODES_FILE}: is missing; ")
