"""What each connection type refuses.

``tests/unit/messages`` has the messages, and ``tests/scenarios`` has the choice of a type.
"""

from __future__ import annotations

from typing import Any

import pytest
from demandops.base.errors import Refused
from demandops.decide.state import State

from tests.kit.connections import REACHABLE, SPEAKS, TYPED, WAN, decided, demand, state

ABLE = state(vehicle00=SPEAKS | TYPED, edge=REACHABLE | WAN)
"""A state in which every type can carry a connection from vehicle00 to the edge."""

_NO_DDS = state(vehicle00=SPEAKS | TYPED | {"ros": {"rmw": "rmw_zenoh_cpp"}}, edge=REACHABLE | WAN)
_ROS = state(vehicle00=TYPED, edge=WAN)
_ONE_RATE = state(vehicle00=SPEAKS, edge=REACHABLE, cloud={"zenoh": {"endpoint": "tcp/c:1"}})
_NARROW = {"wan": {"host": "192.0.2.1", "firstPort": 20000, "lastPort": 20000}}
_UNABLE = {
    "mqtt": [{"rate": 1}],
    "zenoh": [
        {"qos": 1},
        {"retained": True},
        {"primitive": True},
        {"reliability": "reliable"},
        {"durability": "volatile"},
        {"queue": 1},
    ],
    "ros": [{"qos": 1}, {"retained": True}, {"primitive": True}],
}

REFUSED: dict[str, tuple[State, dict[str, Any]]] = {
    **{
        f"an option of another type: {kind}, {next(iter(options))}": (
            ABLE, demand(kind, {"/a": options}),
        )
        for kind, all_options in _UNABLE.items()
        for options in all_options
    },
    "no type that can carry it": (state("", brokers=False), demand()),
    "another name at the target, by Zenoh": (ABLE, demand("zenoh", {"/a": "/b"})),
    "another name at the target, by ROS": (ABLE, demand("ros", {"/a": "/b"})),
    "a broker for Zenoh": (ABLE, demand("zenoh", broker="edge")),
    "a broker for ROS": (ABLE, demand("ros", broker="edge")),
    "a node that does not speak DDS, by Zenoh": (_NO_DDS, demand("zenoh")),
    "a node that does not speak DDS, by ROS": (_NO_DDS, demand("ros")),
    "a node without a bridge": (state(edge=REACHABLE), demand("zenoh")),
    "no way between two bridges": (
        state(
            vehicle00={"zenoh": {"connect": ["tcp/a:1"]}}, edge={"zenoh": {"connect": ["tcp/b:1"]}}
        ),
        demand("zenoh"),
    ),
    "two rates of a topic on a node": (
        decided(_ONE_RATE, demand("zenoh", {"/a": {"rate": 5}})),
        demand("zenoh", {"/a": {"rate": 2}}, id="d", target="cloud"),
    ),
    "no address": (state(vehicle00=TYPED), demand("ros")),
    "no message type": (state(edge=WAN), demand("ros")),
    "no message type of what is carried back": (_ROS, demand("ros", {"/a": {"reverse": True}})),
    "durability without reliability": (_ROS, demand("ros", {"/a": {"durability": "volatile"}})),
    "two connections on one port": (
        decided(state(vehicle00=TYPED, edge=_NARROW), demand("ros")),
        demand("ros", {"/b": {"type": "std_msgs/msg/String"}}, id="d"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_type_cannot_carry_is_refused_at_its_place(name: str) -> None:
    before, asked = REFUSED[name]
    with pytest.raises(Refused) as refused:
        decided(before, asked)
    assert all(found.field.startswith("connections") for found in refused.value.faults)
