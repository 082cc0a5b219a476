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
    NODES_FILE,
    collection_of,
)
from demandops.model.config.load import load

from tests.kit import forms, plain_yaml
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
    assert config.file_of(NODES_FILE, "vehicle07") == VEHICLE
    assert config.file_of(NODES_FILE, "vehicle00") == NODES_FILE


def test_the_faults_of_the_documentation_are_told() -> None:
    head, more = (
        FILES[VEHICLE].partition("  - id")[0],
        "  - {{id: {}, type: edge, cluster: c-its}}\n",
    )
    twice = head + more.format("station01") + more.format("vehicle07")
    assert faults(FILES | {ROADSIDE: twice}) in BLOCKS
    unread = faults({"inventory/vehicles.yaml": FILES[VEHICLE]})
    assert unread.startswith("inventory/vehicles.yaml: is not read; only <name>.yaml and <name>/")


def test_the_folder_alone_is_enough_and_messages_name_it() -> None:
    moved = {NODES_FILE: None, "inventory/nodes/all.yaml": skeleton()[NODES_FILE]}
    assert MemoryRepo(moved).config == load(configuration())
    broker = edited("inventory/brokers.yaml", "node: cloud", "node: clod")
    assert "brokers[0].node: 'clod' is not in nodes/; did you mean" in faults(moved | broker)
    assert faults({NODES_FILE: None}).startswith(f"{NODES_FILE}: is missing; ")
