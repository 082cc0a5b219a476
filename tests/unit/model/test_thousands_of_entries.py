"""A merged file with thousands of entries is loaded, or refused, in time that grows with them.

Work is counted in calls of functions, so the tests need no clock.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import Fault, InvalidInput
from demandops.model.config.config import ConfigReader
from demandops.model.config.cross_check import check_override_conflicts
from demandops.model.config.load import load
from demandops.model.config.override import by_rank
from hypothesis import given
from hypothesis import strategies as st

from tests.kit import plain_yaml
from tests.kit.chance import examples
from tests.kit.config import (
    configuration,
    contested_effects,
    may_select_same_release,
    override,
)
from tests.unit.decide.test_ties import _override, effects, selector

Files = dict[str, str]
CONFIG = load(configuration())


MANY = plain_yaml.load(Path(__file__).with_name("many-entries.yaml").read_text())


def files_of(kind: str, count: int) -> Files:
    """Return the files with ``count`` entries of each form of a case."""
    if kind in TWO:
        return {f"overrides/o{number}.yaml": TWO[kind](number, count) for number in range(2)}
    files = Files()
    for path, document in MANY[kind].items():
        if "{}" in path:
            files |= {
                numbered(path, number): override(*one.pop("select"), **one)
                for number, one in enumerate(numbered(document, n) for n in range(count))
            }
        else:
            entries = {
                field: [numbered(one[0], number) for number in range(count)]
                for field, one in document.items()
                if isinstance(one, list)
            }
            files[path] = yaml.safe_dump({"apiVersion": "demandops/v1"} | document | entries)
    return files


def numbered(entry: Any, number: int) -> Any:
    text = json.dumps(entry).replace(' "{}"', f" {number}")
    return json.loads(text.replace("{}", f"{number:04}"))


TWO: dict[str, Callable[[int, int], str]] = {
    "two overrides with many patterns": lambda i, count: override(
        {"nodes": [f"n{i}-{k}" for k in range(count)]}, replicas=i
    ),
    "two overrides with many selectors": lambda i, count: override(
        *({"nodes": [f"n{i}-{k}"]} for k in range(count)), replicas=i
    ),
}


def work_of(files: Files) -> tuple[int, tuple[Fault, ...]]:
    calls = 0

    def count(*_: object) -> None:
        nonlocal calls
        calls += 1

    whole = configuration(files)
    sys.setprofile(count)
    try:
        load(whole)
    except InvalidInput as invalid:
        return calls, invalid.faults
    finally:
        sys.setprofile(None)
    return calls, ()


@pytest.mark.parametrize("kind", [*MANY, *TWO])
def test_the_work_grows_with_the_entries_and_not_faster(kind: str) -> None:
    work_of({})  # what is read once for all
    none, _ = work_of({})
    few, _ = work_of(files_of(kind, 200))
    many, faults = work_of(files_of(kind, 800))
    assert many - none < 6 * (few - none), "four times as many entries"
    assert len(faults) < 4 * 800


@given(
    st.lists(
        st.tuples(effects, st.lists(selector, min_size=1, max_size=2), st.integers(0, 1)),
        max_size=12,
    )
)
@examples(100)
def test_each_override_that_contradicts_an_earlier_one_is_told(made: list[Any]) -> None:
    named = [
        _override(f"o{number:02}", fields).model_copy(
            update={"select": tuple(select), "priority": priority}
        )
        for number, (fields, select, priority) in enumerate(made)
    ]
    config = replace(CONFIG, overrides={one.name: one for one in named})
    wanted: dict[str, list[str]] = {}
    for one, other in combinations(by_rank(named), 2):
        if (
            one.priority == other.priority
            and contested_effects(one, other)
            and may_select_same_release(one.select, other.select, config)
        ):
            wanted.setdefault(other.path, []).append(one.path)
    reader = ConfigReader({})
    check_override_conflicts(config, reader)
    told: dict[str, list[str]] = {}
    for fault in reader.faults:
        told.setdefault(fault.file, []).append(fault.message.split("as in ")[1].split(", and")[0])
    assert told.keys() == wanted.keys()
    for path, others in told.items():
        assert {*others} <= {*wanted[path]}
        assert len(others) == len({*others}) and len(others) >= min(3, len(wanted[path]))
