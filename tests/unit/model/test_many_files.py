"""A collection may be in one file or in many, without any difference for entries and faults.

The examples come from docs/inventory.md.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.model.config.config import (
    CLIENTS_FILE,
    COLLECTIONS,
    DOMAINS_FILE,
    NODES_FILE,
    collection_of,
)
from demandops.model.config.load import load

from tests.kit import plain_yaml, rich
from tests.kit.config import configuration, edited, skeleton
from tests.kit.memory import MemoryRepo

PAGE = (Path(__file__).parents[3] / "docs" / "inventory.md").read_text()
BLOCKS = re.findall(r"```\w+\n(.*?)```", PAGE, re.DOTALL)
FILES = {
    title.removeprefix("# "): text
    for title, _, text in (block.partition("\n") for block in BLOCKS)
    if title.startswith("# ")
}
VEHICLE, ROADSIDE = "inventory/nodes/vehicle07.yaml", "inventory/nodes/roadside.yaml"


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
    files = rich.rich() if seed % 2 else configuration()
    spread = split(files, Random(seed))
    assert {path for path in spread if collection_of(path) not in (None, path)}
    whole, parts = load(files), load(spread)
    assert parts == whole
    for collection, entries in parts.entry_files.items():
        assert entries.keys() == whole.entry_files[collection].keys()


def test_the_examples_of_the_documentation_join_the_fleet() -> None:
    books = MemoryRepo(FILES)
    assert {"vehicle07", "station01", "vehicle00"} <= books.config.nodes.keys()
    assert books.config.file_of(NODES_FILE, "vehicle07") == VEHICLE
    assert books.config.file_of(NODES_FILE, "vehicle00") == NODES_FILE


def test_an_entry_in_two_files_is_told_for_both() -> None:
    twice = FILES | {
        ROADSIDE: FILES[ROADSIDE] + "  - {id: vehicle07, type: edge, cluster: c-its}\n"
    }
    assert faults(twice) in BLOCKS


def test_a_file_that_nobody_would_read_is_a_fault() -> None:
    assert faults({"inventory/vehicles.yaml": FILES[VEHICLE]}) in BLOCKS


@pytest.mark.parametrize(
    "path",
    [
        "inventory/nodes/more.yml",
        "inventory/nodes/north/more.yaml",
        "inventory/nodes.yml",
        "policy/rules.yaml",
        "policy/access-domains/edge/more.yaml",
        "registry/nodes.yaml",
    ],
)
def test_a_name_that_is_nearly_right_is_a_fault_too(path: str) -> None:
    assert faults({path: "kind: Nodes\n"}).startswith(f"{path}: is not read; ")


def test_files_that_are_no_configuration_are_ignored() -> None:
    odd = ("README.md", "nodes/README.md", "nodes/.draft.yaml", ".old/nodes.yaml", "plan.txt")
    load(configuration({f"inventory/{name}": "not: [yaml" for name in odd}))
    load(configuration({"policy/allowed-signers": ""}))


def test_the_folder_alone_is_enough_and_messages_name_it() -> None:
    moved = {NODES_FILE: None, "inventory/nodes/all.yaml": skeleton()[NODES_FILE]}
    books = MemoryRepo(moved)
    assert books.config == load(configuration())
    broker = edited("inventory/brokers.yaml", "node: cloud", "node: clod")
    assert faults(moved | broker) == (
        "inventory/brokers.yaml: brokers[0].node: 'clod' is not in nodes/; did you mean 'cloud'?\n"
    )
    assert "is not in nodes.yaml or nodes/; " in faults(FILES | broker)
    assert faults({NODES_FILE: None}) == (
        "inventory/nodes.yaml: is missing; `demandops init` creates an example\n"
    )


def test_a_fault_in_one_of_many_files_names_the_file_and_the_field() -> None:
    bad = FILES[VEHICLE].replace("cluster: c-its", "cluster: c-it").replace("  ego_", "  eggo_")
    assert faults(FILES | {VEHICLE: bad}) == (
        f"{VEHICLE}: nodes[0].cluster: 'c-it' is not in clusters.yaml; did you mean 'c-its'?\n"
        f"{VEHICLE}: nodes[0].topics.eggo_data: 'eggo_data' is not an input of any application; "
        "did you mean 'ego_data'?\n"
    )
    assert faults(FILES | {VEHICLE: "kind: Nodes\n"}) == (
        f"{VEHICLE}: apiVersion: is missing; add it\n{VEHICLE}: nodes: is missing; add it\n"
    )
    domains = skeleton()[DOMAINS_FILE].replace("name: perception", "name: other")
    domains = domains.replace('["*"]', "[nobody]")
    second = "policy/access-domains/other.yaml"
    assert faults({second: domains}) == (
        f"{second}: domains[0].namespace: 'perception' is already the namespace of 'perception'; "
        "give each access domain its own namespace\n"
    )


def test_images_of_a_file_come_from_its_registry() -> None:
    head = "apiVersion: demandops/v1\nkind: Images\nregistry: mirror.example:5000\nimages:\n"
    mine = "registry/images/mine.yaml"
    images = load(configuration({mine: f"{head}  recorder: {{repository: x/recorder, tag: v1}}\n"}))
    assert images.images["recorder"].repository == "mirror.example:5000/x/recorder"
    assert images.images["object-fusion"].repository.startswith("docker.io/")


def test_settings_of_a_connection_type_are_in_one_file() -> None:
    head = "apiVersion: demandops/v1\nkind: Clients\n"
    clients = "registry/clients/zenoh.yaml"
    config = load(configuration({clients: f"{head}zenoh: {{hostNetwork: false}}\n"}))
    assert config.clients.zenoh.host_network is False
    assert config.clients.mqtt.launch_file == "standalone.launch.ros2.xml"
    assert faults({clients: f"{head}mqtt: {{launchFile: x}}\n"}) == (
        f"registry/clients.yaml: mqtt: 'mqtt' is in {clients} too; remove one\n"
        f"{clients}: mqtt: 'mqtt' is in registry/clients.yaml too; remove one\n"
    )
