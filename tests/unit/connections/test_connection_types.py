"""Which type carries a connection: the automatic choice, and what each type refuses."""

from __future__ import annotations

from typing import Any

import pytest
from demandops.connections.connection_type import ConnectionType
from demandops.connections.mqtt import MQTT
from demandops.connections.ros import ROS
from demandops.connections.zenoh import ZENOH
from demandops.decision import State
from demandops.errors import Refused
from demandops.ledger.ledger import Ledger

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


def faults(before: State, asked: dict[str, Any]) -> list[str]:
    with pytest.raises(Refused) as refused:
        decided(before, asked)
    return [f"{one.field}: {one.message}" for one in refused.value.faults]


class TestAutomaticChoice:
    """Zenoh where both speak it, else MQTT where there is a broker, else ROS, else refused."""

    def test_zenoh_where_both_nodes_speak_it(self) -> None:
        assert carried(state(vehicle00=SPEAKS, edge=REACHABLE), demand()) is ZENOH

    def test_zenoh_where_both_connect_to_one_router(self) -> None:
        both = {"zenoh": {"connect": ["tcp/router:7447"]}}
        assert carried(state(vehicle00=both, edge=both), demand()) is ZENOH

    def test_mqtt_where_one_does_not(self) -> None:
        assert carried(state(edge=REACHABLE), demand()) is MQTT

    def test_mqtt_where_neither_can_be_reached(self) -> None:
        assert carried(state(vehicle00=SPEAKS, edge=SPEAKS), demand()) is MQTT

    def test_mqtt_where_the_registry_has_no_bridge(self) -> None:
        found = state("", vehicle00=SPEAKS, edge=REACHABLE)
        assert carried(found, demand()) is MQTT

    def test_mqtt_for_what_zenoh_cannot_do(self) -> None:
        found = state(vehicle00=SPEAKS, edge=REACHABLE)
        for topics in ({"/a": "/b"}, {"/a": {"qos": 1}}):
            assert carried(found, demand(topics=topics)) is MQTT
        assert carried(found, demand(broker="edge")) is MQTT

    def test_ros_where_there_is_no_broker(self) -> None:
        found = state(brokers=False, vehicle00=TYPED, edge=WAN)
        assert carried(found, demand()) is ROS

    def test_where_nothing_can_carry_it_each_is_told(self) -> None:
        assert faults(state("", brokers=False), demand()) == [
            "connections[0].type: is not given, and no type can carry it. ZENOH: 2 (ZENOH) needs "
            "an "
            "image 'zenoh-bridge'; add it to registry/images.yaml; MQTT: broker is not given, "
            "and no broker runs on 'edge' or 'vehicle00'; inventory/brokers.yaml has none; add "
            "one there; "
            "ROS: 0 (ROS) needs an image 'dds-router'; add it to registry/images.yaml"
        ]

    def test_what_stands_keeps_its_type(self) -> None:
        before = state(vehicle00=SPEAKS, edge=REACHABLE)
        after = decided(before, demand("mqtt"))
        again = demand(requesters=["vehicle01"])
        after = decided(after, again)
        assert {claim.connection.type for claim in after.ledger.connection_claims("c")} == {MQTT}

    def test_a_shutdown_without_a_type_means_what_stands(self) -> None:
        before = state(vehicle00=SPEAKS, edge=REACHABLE)
        after = decided(before, demand("mqtt"))
        after = decided(after, demand() | {"shutdown": True})
        assert after.ledger == Ledger()

    def test_the_wire_cannot_ask_for_it(self) -> None:
        (found,) = MemoryRepo().faults(goal([], [connection(type=-1)]))
        assert found.startswith("connections[0].type: input should be greater than or equal to 0")


class TestOptions:
    """An option that a type cannot honour is refused, naming the types that can."""

    @pytest.mark.parametrize(
        ("kind", "options", "able"),
        [
            ("mqtt", {"rate": 1}, "2 (ZENOH) or 0 (ROS)"),
            ("zenoh", {"qos": 1}, "1 (MQTT)"),
            ("zenoh", {"retained": True}, "1 (MQTT)"),
            ("zenoh", {"primitive": True}, "1 (MQTT)"),
            ("zenoh", {"reliability": "reliable"}, "1 (MQTT) or 0 (ROS)"),
            ("zenoh", {"durability": "volatile"}, "1 (MQTT) or 0 (ROS)"),
            ("zenoh", {"queue": 1}, "1 (MQTT) or 0 (ROS)"),
            ("ros", {"qos": 1}, "1 (MQTT)"),
            ("ros", {"retained": True}, "1 (MQTT)"),
            ("ros", {"primitive": True}, "1 (MQTT)"),
        ],
    )
    def test_it_is_refused(self, kind: str, options: dict[str, Any], able: str) -> None:
        (name,) = options
        found = state(vehicle00=SPEAKS | TYPED, edge=REACHABLE | WAN)
        assert faults(found, demand(kind, {"/a": options})) == [
            f"connections[0].topics[0].{name}: {name} of '/a' is not supported by "
            f"{kind.upper()}; leave it out, or use type {able}"
        ]

    @pytest.mark.parametrize("kind", ["zenoh", "ros"])
    def test_another_name_at_the_target_is_of_mqtt_only(self, kind: str) -> None:
        found = state(vehicle00=SPEAKS | TYPED, edge=REACHABLE | WAN)
        assert faults(found, demand(kind, {"/a": "/b"})) == [
            f"connections[0].topics[0].target: '/a' cannot become '/b': {kind.upper()} keeps the "
            "name; use one name, or type 1 (MQTT)"
        ]

    @pytest.mark.parametrize("kind", ["zenoh", "ros"])
    def test_a_broker_is_of_mqtt_only(self, kind: str) -> None:
        found = state(vehicle00=SPEAKS | TYPED, edge=REACHABLE | WAN)
        assert faults(found, demand(kind, broker="edge")) == [
            f"connections[0].broker: is for MQTT only, and the type is {kind.upper()}; leave it out"
        ]

    @pytest.mark.parametrize("kind", ["zenoh", "ros"])
    def test_a_node_that_does_not_speak_dds(self, kind: str) -> None:
        other = {"ros": {"rmw": "rmw_zenoh_cpp"}}
        found = state(vehicle00=SPEAKS | TYPED | other, edge=REACHABLE | WAN)
        assert faults(found, demand(kind)) == [
            f"connections[0].source: 'vehicle00' runs rmw_zenoh_cpp, and {kind.upper()} clients "
            "speak DDS; use type 1 (MQTT), or another rmw in inventory/nodes.yaml"
        ]


class TestZenoh:
    """What the inventory must have for it."""

    def test_a_node_without_a_bridge(self) -> None:
        assert faults(state(edge=REACHABLE), demand("zenoh")) == [
            "connections[0].source: 'vehicle00' runs no Zenoh bridge; add zenoh: {endpoint: …} to "
            "it in inventory/nodes.yaml, or zenoh: {} if it can reach others"
        ]

    def test_no_way_between_the_two(self) -> None:
        one = {"zenoh": {"connect": ["tcp/a:1"]}}
        other = {"zenoh": {"connect": ["tcp/b:1"]}}
        assert faults(state(vehicle00=one, edge=other), demand("zenoh")) == [
            "connections[0].type: 2 (ZENOH) finds no route between 'vehicle00' and 'edge'; give "
            "one "
            "of them an endpoint under zenoh in inventory/nodes.yaml, or add the same router to "
            "connect of both"
        ]

    def test_one_topic_has_one_rate_on_a_node(self) -> None:
        before = state(vehicle00=SPEAKS, edge=REACHABLE, cloud={"zenoh": {"endpoint": "tcp/c:1"}})
        asked = demand("zenoh", {"/a": {"rate": 5}})
        before = decided(before, asked)
        other = demand("zenoh", {"/a": {"rate": 2}}, id="d", target="cloud")
        assert faults(before, other) == [
            "connections: rate 2.0 of '/a' in 'd' contradicts an existing claim: 'c' carries it "
            "from "
            "'vehicle00' with rate 5.0, and the node's bridge has one rate for each topic; "
            "use the same rate"
        ]


class TestRos:
    """What inventory and request must have for it."""

    def test_no_address(self) -> None:
        assert faults(state(vehicle00=TYPED), demand("ros")) == [
            "connections[0].type: 0 (ROS) needs an end with a reachable address; add "
            "wan: {host: …} to 'vehicle00' or 'edge' in inventory/nodes.yaml"
        ]

    def test_no_message_type(self) -> None:
        assert faults(state(edge=WAN), demand("ros")) == [
            "connections[0].topics[0].type: the message type of '/a' is not known, and ROS needs "
            "it; give it in the request if it has a field for it, or add it to types of "
            "'vehicle00' in inventory/nodes.yaml"
        ]

    def test_the_type_of_a_topic_that_is_carried_back_is_the_targets(self) -> None:
        asked = demand("ros", {"/a": {"reverse": True}})
        assert "types of 'edge'" in faults(state(vehicle00=TYPED, edge=WAN), asked)[0]
        assert carried(state(edge=WAN | TYPED), asked) is ROS

    def test_durability_needs_reliability(self) -> None:
        asked = demand("ros", {"/a": {"durability": "volatile"}})
        assert faults(state(vehicle00=TYPED, edge=WAN), asked) == [
            "connections[0].topics[0].reliability: is not given, but durability of '/a' is set; "
            "ROS "
            "needs both, add it"
        ]

    def test_two_connections_on_one_port(self) -> None:
        narrow = {"wan": {"host": "192.0.2.1", "firstPort": 20000, "lastPort": 20000}}
        before = state(vehicle00=TYPED, edge=narrow)
        before = decided(before, demand("ros"))
        assert faults(before, demand("ros", id="d")) == [
            "connections: connection 'd' would listen on port 20000 of 'edge', but 'c' listens "
            "there; use another connection id, or widen firstPort and lastPort under wan of 'edge'"
        ]


class TestThroughTheWire:
    """The reference's message names the three types by number, and says nothing of options."""

    def books(self, **nodes: dict[str, Any]) -> MemoryRepo:
        books = MemoryRepo()
        books.state = state(**nodes)
        return books

    @pytest.mark.parametrize(("number", "name"), [(0, "ROS"), (1, "MQTT"), (2, "ZENOH")])
    def test_each_type_is_honoured_where_the_inventory_allows(self, number: int, name: str) -> None:
        books = self.books(vehicle00=SPEAKS | TYPED, edge=REACHABLE | WAN)
        asked = connection("c", topics=["/a"], broker="", type=number)
        assert books.send(goal([], [asked])).outcome == "booked"
        assert books.send(goal([], [asked])).outcome == "unchanged"
        (claim,) = books.state.ledger.connection_claims("c")
        assert claim.connection.known_type.name == name
        assert books.books()["connections"]["c"]["topics"] == ["/a"]
        assert books.send(goal([], [asked], shutdown=True)).outcome == "released"
        assert len(books.state.ledger) == 0

    def test_a_message_type_that_is_missing_is_told_in_words_of_the_wire(self) -> None:
        books = self.books(edge=WAN)
        (found,) = books.faults(goal([], [connection(topics=["/x"], broker="", type=0)]))
        assert found.startswith("connections[0].source_topics[0]: the message type of '/x'")

    def test_what_is_bridged_already_is_a_warning(self) -> None:
        books = self.books(vehicle00={"bridged": {"edge": ["/a"]}})
        decision = books.send(goal([], [connection("c", topics=["/a", "/b"])]))
        assert decision.warnings == (
            "connection 'c': /a is bridged between 'vehicle00' and 'edge' already, so no client "
            "carries it",
        )
        assert len(decision.releases) == 2
