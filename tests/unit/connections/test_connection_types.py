"""The automatic choice of a connection's type, and what each type refuses.

``tests/unit/messages`` has the messages for ``REFUSED``.
"""

from __future__ import annotations

from typing import Any

import pytest
from demandops.connections.connection import ConnectionType
from demandops.connections.mqtt import MQTT
from demandops.connections.ros import ROS
from demandops.connections.zenoh import ZENOH
from demandops.decide.state import State
from demandops.model.ledger.ledger import Ledger

from tests.kit.connections import (
    REACHABLE,
    SPEAKS,
    TYPED,
    WAN,
    decided,
    demand,
    state,
)
from tests.kit.goals import connection, goal
from tests.kit.memory import MemoryRepo


def carried(before: State, asked: dict[str, Any]) -> ConnectionType:
    after = decided(before, asked)
    (claim,) = after.ledger.connection_claims("c")
    return claim.connection.known_type


ABLE = state(vehicle00=SPEAKS | TYPED, edge=REACHABLE | WAN)
"""A state in which every type can carry a connection from vehicle00 to the edge."""

BRIDGES = state(vehicle00=SPEAKS, edge=REACHABLE)
_ONE_ROUTER = {"zenoh": {"connect": ["tcp/router:7447"]}}
ROUTER = state(vehicle00=_ONE_ROUTER, edge=_ONE_ROUTER)
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
        decided(state(vehicle00=TYPED, edge=_NARROW), demand("ros")), demand("ros", id="d"),
    ),
}  # fmt: skip


class TestAutomaticChoice:
    """A connection without a type gets the first of Zenoh, MQTT and ROS that can carry it."""

    @pytest.mark.parametrize(
        ("before", "asked", "chosen"),
        [
            pytest.param(BRIDGES, demand(), ZENOH, id="both nodes speak Zenoh"),
            pytest.param(ROUTER, demand(), ZENOH, id="both connect to one router"),
            pytest.param(state(edge=REACHABLE), demand(), MQTT, id="one does not speak Zenoh"),
            pytest.param(
                state(vehicle00=SPEAKS, edge=SPEAKS), demand(), MQTT, id="neither can be reached"
            ),
            pytest.param(
                state("", vehicle00=SPEAKS, edge=REACHABLE), demand(), MQTT, id="no image of Zenoh"
            ),
            pytest.param(BRIDGES, demand(topics={"/a": "/b"}), MQTT, id="a name that changes"),
            pytest.param(BRIDGES, demand(topics={"/a": {"qos": 1}}), MQTT, id="an option of MQTT"),
            pytest.param(BRIDGES, demand(broker="edge"), MQTT, id="a broker"),
            pytest.param(
                state(brokers=False, vehicle00=TYPED, edge=WAN), demand(), ROS, id="no broker"
            ),
            pytest.param(
                state(edge=WAN | TYPED),
                demand("ros", {"/a": {"reverse": True}}),
                ROS,
                id="the target's message type of what is carried back",
            ),
        ],
    )
    def test_the_first_type_that_can_carry_it(
        self, before: State, asked: dict[str, Any], chosen: ConnectionType
    ) -> None:
        assert carried(before, asked) is chosen

    def test_a_demand_without_a_type_keeps_the_type_of_the_connection(self) -> None:
        after = decided(BRIDGES, demand("mqtt"))
        again = demand(requesters=["vehicle01"])
        after = decided(after, again)
        assert {claim.connection.type for claim in after.ledger.connection_claims("c")} == {MQTT}

    def test_a_shutdown_without_a_type_releases_a_connection_of_any_type(self) -> None:
        after = decided(BRIDGES, demand("mqtt"))
        after = decided(after, demand() | {"shutdown": True})
        assert after.ledger == Ledger()


class TestThroughTheWire:
    """The reference's message names the three types by number, and has no options."""

    @pytest.mark.parametrize(("number", "name"), [(0, "ROS"), (1, "MQTT"), (2, "ZENOH")])
    def test_each_type_is_honoured_where_the_inventory_allows(self, number: int, name: str) -> None:
        books = MemoryRepo(state=ABLE)
        asked = connection("c", topics=["/a"], broker="", type=number)
        assert books.send(goal([], [asked])).outcome == "booked"
        assert books.send(goal([], [asked])).outcome == "unchanged"
        (claim,) = books.state.ledger.connection_claims("c")
        assert claim.connection.known_type.name == name
        assert books.books()["connections"]["c"]["topics"] == {"/a": ["vehicle00"]}
        assert books.send(goal([], [asked], shutdown=True)).outcome == "released"
        assert len(books.state.ledger) == 0

    def test_a_message_type_that_is_missing_is_told_in_words_of_the_wire(self) -> None:
        repo = MemoryRepo(state=state(edge=WAN))
        (found,) = repo.faults(goal([], [connection(topics=["/x"], broker="", type=0)]))
        assert found.startswith("connections[0].source_topics[0]: the message type of '/x'")

    def test_a_topic_that_is_bridged_already_gives_a_warning(self) -> None:
        books = MemoryRepo(state=state(vehicle00={"bridged": {"edge": ["/a"]}}))
        decision = books.send(goal([], [connection("c", topics=["/a", "/b"])]))
        assert decision.warnings == (
            "connection 'c': the initial deployment already carries /a between 'vehicle00' and "
            "'edge' (bridged in the inventory), so no client of this connection carries it",
        )
        assert len(decision.releases) == 2
