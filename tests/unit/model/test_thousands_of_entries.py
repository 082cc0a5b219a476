"""A merged file with thousands of entries is loaded, or refused, in time that grows with them.

Work is counted in calls of functions, so the tests need no clock.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from typing import Any

import pytest
import yaml
from demandops.base.errors import Fault, InvalidInput
from demandops.model.config.config import ConfigReader
from demandops.model.config.load import load
from demandops.model.config.override import by_rank
from demandops.model.config.override_conflicts import check_override_conflicts, contested_effects
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.config import configuration, may_select_same_release, override
from tests.unit.decide.test_ties import _override, effects, selector

Files = dict[str, str]
CONFIG = load(configuration())


def listed(path: str, kind: str, field: str, items: list[dict[str, Any]]) -> Files:
    return {path: yaml.safe_dump({"apiVersion": "demandops/v1", "kind": kind, field: items})}


def nodes(count: int, **more: Callable[[int], Any]) -> Files:
    node = {"type": "edge", "cluster": "c-its"}
    made = [
        node | {"id": f"n{number}"} | {name: value(number) for name, value in more.items()}
        for number in range(count)
    ]
    return listed("inventory/nodes/more.yaml", "Nodes", "nodes", made)


def domains(count: int, pattern: Callable[[int], str]) -> Files:
    made = [
        {"name": f"d{number}", "namespace": f"d{number}", "nodes": [pattern(number)]}
        for number in range(count)
    ]
    return listed("policy/access-domains/more.yaml", "AccessDomains", "domains", made)


def brokers(count: int) -> Files:
    made = [{"node": f"b{number}", "host": "h", "port": 1883} for number in range(count)]
    return listed("inventory/brokers/more.yaml", "Brokers", "brokers", made)


def overrides(count: int, fields: Callable[[int], dict[str, Any]]) -> Files:
    made = ({"select": [{"nodes": ["*"]}]} | fields(number) for number in range(count))
    return {
        f"overrides/o{number:04}.yaml": override(*one.pop("select"), **one)
        for number, one in enumerate(made)
    }


MANY: dict[str, Callable[[int], Files]] = {
    "nodes": nodes,
    "nodes of unknown clusters": lambda n: nodes(n, cluster=lambda i: f"c{i}"),
    "nodes with unknown peers": lambda n: nodes(n, bridged=lambda i: {f"p{i}": ["/a"]}),
    "nodes in domains of their own": lambda n: nodes(n) | domains(n, lambda i: f"n{i}"),
    "nodes in too many domains": lambda n: nodes(n) | domains(n, lambda i: "n*"),
    "brokers on unknown nodes": lambda n: nodes(n) | brokers(n),
    "overrides that contradict each other": lambda n: overrides(n, lambda i: {"replicas": i}),
    "overrides that say the same": lambda n: overrides(n, lambda i: {"replicas": 1}),
    "overrides of nodes of their own": lambda n: overrides(
        n, lambda i: {"select": [{"nodes": [f"n{i}"]}], "replicas": i}
    ),
    "overrides of parts of names": lambda n: overrides(
        n, lambda i: {"select": [{"nodes": [f"n{i:04}*"]}], "replicas": i}
    ),
    "overrides of applications": lambda n: overrides(
        n, lambda i: {"select": [{"applications": [f"a{i}"], "services": ["x"]}], "replicas": i}
    ),
    "patches of the same value": lambda n: overrides(n, lambda i: {"values": {"k": {"l": i}}}),
    "patches of different values": lambda n: overrides(n, lambda i: {"values": {f"k{i}": i}}),
    "holds of what others change": lambda n: overrides(
        n, lambda i: {"hold": True} if i % 2 else {"replicas": 2}
    ),
    "moves to unknown nodes": lambda n: overrides(n, lambda i: {"node": f"v{i}"}) | nodes(n),
    "two overrides with many patterns": lambda n: overrides(
        2, lambda i: {"select": [{"nodes": [f"n{i}-{k}" for k in range(n)]}], "replicas": i}
    ),
    "two overrides with many selectors": lambda n: overrides(
        2, lambda i: {"select": [{"nodes": [f"n{i}-{k}"]} for k in range(n)], "replicas": i}
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


@pytest.mark.parametrize("kind", MANY)
def test_the_work_grows_with_the_entries_and_not_faster(kind: str) -> None:
    work_of({})  # what is read once for all
    none, _ = work_of({})
    few, _ = work_of(MANY[kind](200))
    many, faults = work_of(MANY[kind](800))
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
