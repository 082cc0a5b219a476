"""Clients get only parameters that their programs declare, as `declared.yaml` lists them.

Each tested connection has every option of its type in both directions, so that the clients get
every parameter.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
from demandops.connections import connection_types
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import all_keys
from demandops.decide.state import State
from demandops.model.config.inventory import Tls
from demandops.model.ledger.ledger import World

from tests.kit import plain_yaml
from tests.kit.connections import REACHABLE, SPEAKS, TYPED, WAN, decided, demand, state

DECLARED = plain_yaml.load((Path(__file__).parent / "declared.yaml").read_text())
OPTIONS: dict[str, dict[str, Any]] = {
    "mqtt": {
        "qos": 2,
        "primitive": True,
        "reliability": "reliable",
        "durability": "volatile",
        "queue": 3,
        "type": "std_msgs/msg/String",
    },
    "zenoh": {"rate": 2.0},
    "ros": {
        "rate": 2.0,
        "reliability": "reliable",
        "durability": "transient_local",
        "queue": 3,
        "type": "std_msgs/msg/String",
    },
}


def with_all_options(kind: str) -> State:
    options = OPTIONS[kind] | ({"retained": True} if kind == "mqtt" else {})
    topics = {
        "/a": {"target": "/a", **options},
        "/b": {"target": "/b", "reverse": True, **options},
    }
    start = state(vehicle00=SPEAKS | TYPED, edge=REACHABLE | WAN)
    brokers = {
        name: broker.model_copy(update={"tls": Tls(caSecret="ca")})
        for name, broker in start.config.brokers.items()
    }
    config = replace(start.config, brokers=MappingProxyType(brokers))
    return decided(replace(start, config=config), demand(kind, topics))


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield (path, name of the Python type) for each value in nested mappings and lists."""
    if isinstance(value, dict):
        for key, item in value.items():
            name = "{}" if "/" in key else key
            yield from leaves(item, f"{path}.{name}" if path else name)
    elif isinstance(value, list):
        for item in value:
            yield from leaves(item, f"{path}[]")
    else:
        yield path, type(value).__name__


def written(kind: str) -> set[tuple[str, str]]:
    world: World = with_all_options(kind)
    found = set[tuple[str, str]]()
    for key in all_keys(world):
        configuration = plan(world, key).configuration()  # type: ignore[union-attr]
        found |= {*leaves(configuration.get("/**/*", {}).get("ros__parameters", configuration))}
    return found


@pytest.mark.parametrize("program", DECLARED, ids=lambda one: f"{one['program']} {one['version']}")
def test_a_program_declares_all_that_its_clients_are_told(program: dict[str, Any]) -> None:
    told = written(program["type"])
    assert told - {*program["reads"].items()} == set()


def test_there_is_a_program_for_each_connection_type() -> None:
    words = {known.word for known in connection_types.CONNECTION_TYPES}
    assert {program["type"] for program in DECLARED} == words == OPTIONS.keys()


@pytest.mark.parametrize("kind", OPTIONS)
def test_every_option_of_a_type_is_tried(kind: str) -> None:
    known = connection_types.type_named(kind).options
    assert known - OPTIONS[kind].keys() <= {"retained"}
