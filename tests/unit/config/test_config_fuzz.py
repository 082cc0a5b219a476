"""Whatever people make of the files: they are taken, or refused with faults that name a file."""

from __future__ import annotations

import json
from random import Random
from typing import Any

import pytest
import yaml
from demandops.config.load import load
from demandops.decision import State, try_configuration
from demandops.errors import InvalidInput
from demandops.ledger.ledger import Ledger

from tests.kit.config import FAST, configuration, skeleton

FILES = sorted(
    path
    for path in configuration()
    if path.endswith((".yaml", ".json")) and "/templates/" not in path
)
OF_CHARTS = [path for path in FILES if "/charts/" in path]
"""Files without a schema; ``test_mistakes_anywhere`` tries the others."""
ODD: tuple[Any, ...] = (
    None, True, 5, -1, 1.5, 10**30, "", "x", "a b", "../..", "é" * 80, [], {}, [None], {"a": None},
    [[]], {"x": {"y": []}}, "2026-01-31", "\n", "{{ x }}",
)  # fmt: skip


def places(data: Any) -> list[tuple[Any, Any]]:
    """Return every (mapping or list, key or index) in a document."""
    found: list[tuple[Any, Any]] = []
    if isinstance(data, dict | list):
        items = data.items() if isinstance(data, dict) else enumerate(data)
        for key, value in list(items):
            found += [(data, key), *places(value)]
    return found


def mutated(text: str, random: Random) -> str:
    """Return a document with a value changed, doubled or left out."""
    data = yaml.load(text, Loader=FAST)  # noqa: S506 - derives from SafeLoader
    holder, key = random.choice(places(data))
    change = random.randrange(4)
    if change == 0:
        del holder[key]
    elif change == 1 and isinstance(holder, list):
        holder.append(holder[key])
    elif change == 2 and isinstance(holder, dict):
        holder[random.choice(["x", key, key.upper(), 5])] = holder.pop(key)
    else:
        holder[key] = random.choice(ODD)
    if text.startswith("{"):
        return json.dumps(data)
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def assert_told(path: str, text: str) -> None:
    try:
        try_configuration(State.of(load(configuration({path: text})), Ledger()))
    except InvalidInput as invalid:
        assert invalid.faults
        for found in invalid.faults:
            assert found.file, f"which file? {found}"
            assert found.message


@pytest.mark.parametrize("path", OF_CHARTS)
def test_whatever_stands_in_a_file_is_taken_or_refused_with_a_fault(path: str) -> None:
    for seed in range(30):
        assert_told(path, mutated(skeleton()[path], Random(f"{path}{seed}")))


@pytest.mark.parametrize("path", FILES)
def test_a_file_cut_off_anywhere_is_taken_or_refused_with_a_fault(path: str) -> None:
    random = Random(path)
    for _ in range(10):
        assert_told(path, skeleton()[path][: random.randrange(len(skeleton()[path]))])
