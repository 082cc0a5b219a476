"""Options of routes; ``tests/scenarios`` has what routes of a connection must agree on."""

from __future__ import annotations

import pytest
from demandops.connections.connection import (
    ROUTE_OPTIONS,
    Connection,
    Route,
    contradictions,
    merged_routes,
)
from demandops.connections.connection_types import CONNECTION_TYPES
from pydantic import TypeAdapter

OPTIONS: dict[str, object] = {
    "type": "std_msgs/msg/String",
    "reverse": True,
    "qos": 2,
    "retained": True,
    "primitive": True,
    "reliability": "best_effort",
    "durability": "volatile",
    "queue": 7,
    "rate": 0.5,
}


def test_a_route_carries_exactly_the_options_that_are_given() -> None:
    assert Route("/a", "/b").options() == {}
    route = TypeAdapter(Route).validate_python({"source": "a", "target": "/b", **OPTIONS})
    assert (route.source, route.target, route.options()) == ("/a", "/b", OPTIONS)


def test_every_option_does_something_in_some_client() -> None:
    honoured = frozenset().union(*(known.options for known in CONNECTION_TYPES))
    assert honoured == {*ROUTE_OPTIONS} - {"type", "reverse"}


def test_a_type_that_is_not_said_contradicts_none_and_is_filled_in() -> None:
    plain, typed = Route("/a", "/a"), Route("/a", "/a", type="std_msgs/msg/String")
    assert not list(contradictions(plain, typed))
    assert merged_routes([plain, typed]) == merged_routes([typed, plain]) == (typed,)
    other = Route("/a", "/a", type="std_msgs/msg/Bool")
    assert list(contradictions(typed, other)) == [
        ("type", "'std_msgs/msg/String'", "'std_msgs/msg/Bool'")
    ]


@pytest.mark.parametrize(
    ("reverse", "topics", "nodes"),
    [(False, ("/a", "/b"), ("s", "t")), (True, ("/b", "/a"), ("t", "s"))],
)
def test_where_messages_come_from_and_arrive(
    reverse: bool, topics: tuple[str, str], nodes: tuple[str, str]
) -> None:
    connection = Connection(source="s", target="t", topics=(Route("/a", "/b", reverse=reverse),))
    sender, read, receiver, written = connection.key_of(*connection.topics)
    assert (read, written) == topics
    assert (sender, receiver) == nodes
