"""Which routes are valid, whatever connection type carries them."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from demandops.connections.connection import (
    Route,
    RouteOptions,
    contradictions,
    faults,
    merged_routes,
)
from demandops.connections.connection_types import CONNECTION_TYPES
from demandops.model.config.base_model import parse

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


def told(found: Any) -> list[str]:
    return [f"{one.field}: {one.message}" for one in found]


def test_a_route_carries_exactly_the_options_that_are_given() -> None:
    assert RouteOptions().route("/a", "/b") == Route("/a", "/b")
    assert Route("/a", "/b").options() == {}
    route = parse(RouteOptions, OPTIONS).route("/a", "/b")
    assert (route.source, route.target, route.options()) == ("/a", "/b", OPTIONS)


def test_options_and_routes_have_the_same_fields_and_defaults() -> None:
    of_route = {item.name: item.default for item in fields(Route)}
    assert of_route.keys() - {"source", "target"} == RouteOptions.model_fields.keys()
    for name, field in RouteOptions.model_fields.items():
        assert field.default == of_route[name]


def test_every_option_does_something_in_some_client() -> None:
    honoured = frozenset().union(*(known.options for known in CONNECTION_TYPES))
    assert honoured == RouteOptions.model_fields.keys() - {"type", "reverse"}


def test_a_topic_listed_with_two_ways_to_carry_it_is_told() -> None:
    routes = [Route("/a", "/b"), Route("/a", "/b", qos=1, reverse=True)]
    assert told(faults("topics", routes)) == [
        "topics[1].reverse: '/a' is listed with reverse false and true; list it once",
        "topics[1].qos: '/a' is listed with qos 0 and 1; list it once",
    ]


def test_a_topic_that_is_carried_back_goes_to_one_place() -> None:
    routes = [Route("/a", "/x", reverse=True), Route("/b", "/x", reverse=True)]
    assert told(faults("topics", routes)) == [
        "topics[1].target: '/x' is carried back to '/a' and to '/b'; a connection carries a target "
        "topic back to only one source topic, so use a second connection"
    ]


def test_two_topics_may_arrive_as_one() -> None:
    assert not list(faults("topics", [Route("/a", "/x"), Route("/b", "/x")]))


def test_a_type_that_is_not_said_contradicts_none_and_is_filled_in() -> None:
    plain, typed = Route("/a", "/a"), Route("/a", "/a", type="std_msgs/msg/String")
    assert not list(contradictions(plain, typed))
    assert merged_routes([plain, typed]) == merged_routes([typed, plain]) == (typed,)
    other = Route("/a", "/a", type="std_msgs/msg/Bool")
    assert list(contradictions(typed, other)) == [
        ("type", "'std_msgs/msg/String'", "'std_msgs/msg/Bool'")
    ]


def test_where_messages_come_from_and_arrive() -> None:
    there, back = Route("/a", "/b"), Route("/a", "/b", reverse=True)
    assert (there.read_topic, there.written_topic, there.sender_and_receiver("s", "t")) == (
        "/a",
        "/b",
        ("s", "t"),
    )
    assert (back.read_topic, back.written_topic, back.sender_and_receiver("s", "t")) == (
        "/b",
        "/a",
        ("t", "s"),
    )
