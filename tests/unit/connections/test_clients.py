"""The configuration of Zenoh bridges, DDS routers and MQTT clients follows routes and options."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from datetime import datetime
from typing import Any, ClassVar

import pytest
import yaml
from demandops.base.errors import InvalidInput, Refused
from demandops.base.naming import Subject, SubjectKind
from demandops.connections.connection import ClientKey, Route
from demandops.connections.zenoh import ZENOH
from demandops.decide.changeset import ReleaseChange
from demandops.decide.decision import Decision
from demandops.decide.planning.release_keys import affected_keys
from demandops.decide.state import State, rendered_files
from demandops.model.config.load import load
from demandops.model.ledger.ledger import changes_on

from tests.kit.config import skeleton, state_of
from tests.kit.connections import (
    REACHABLE,
    SPEAKS,
    TYPED,
    WAN,
    demand,
    routes,
    schema_faults,
    state,
)
from tests.kit.memory import MemoryRepo


class World(MemoryRepo):
    """A state repo in memory that takes demands in the short form of :func:`demand`."""

    def __init__(self, before: State) -> None:
        super().__init__(state=before)
        self.releases: tuple[ReleaseChange, ...] = ()

    def send(self, asked: Any, now: datetime | None = None) -> Decision:
        decision = super().send(routes(asked), now)
        self.releases = decision.releases
        return decision

    def clients(self) -> dict[str, Any]:
        """Return each client's configuration, by the client's name."""
        return {name: documents[0]["data"] for name, documents in self._pods().items()}

    def checksums(self) -> dict[str, str]:
        """Return each client's checksum, by name. A new checksum restarts the client."""
        return {
            name: pod["spec"]["template"]["metadata"]["annotations"]["demandops/config-checksum"]
            for name, (_, pod) in self._pods().items()
        }

    def _pods(self) -> dict[str, list[Any]]:
        found = {}
        for path, text in self.files.items():
            name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
            if path.startswith("clusters/") and name.split("-")[0] in ("mqtt", "zenoh", "ros"):
                found[name] = list(yaml.safe_load_all(text))
        return found

    def zenoh(self, node: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.clients()[f"zenoh-{node}"]["config.json5"])
        return found


def zenoh_world() -> World:
    return World(state(vehicle00=SPEAKS, vehicle01=SPEAKS, edge=REACHABLE))


class TestZenoh:
    """A node has one Zenoh bridge, for all topics that the node sends and receives."""

    def test_both_nodes_of_a_connection_are_affected_and_no_other(self) -> None:
        world = zenoh_world()
        before = world.state.ledger
        world.send(demand("zenoh", {"/b": "/b"}, id="other", source="vehicle01"))
        world.send(demand("zenoh"))
        subject = Subject(SubjectKind.CONNECTION, "c")
        changes = changes_on(before, world.state.ledger, [subject])
        keys = affected_keys(replace(world.state, ledger=before), world.state, changes)
        assert keys == (ClientKey(ZENOH, "vehicle00"), ClientKey(ZENOH, "edge"))
        assert [(found.name, found.change) for found in world.releases] == [
            ("zenoh-vehicle00", "start"),
            ("zenoh-edge", "change"),
        ]
        assert world.releases[1].details == ("+ connection c", "+ writes /a")

    def test_of_two_that_can_be_reached_one_connects(self) -> None:
        other = {"zenoh": {"endpoint": "tcp/vehicle00:7447"}}
        world = World(state(vehicle00=other, edge=REACHABLE))
        for id, source, target in (("c", "vehicle00", "edge"), ("d", "edge", "vehicle00")):
            world.send(demand("zenoh", {f"/{id}": f"/{id}"}, id=id, source=source, target=target))
        assert world.zenoh("edge")["connect"] == {"endpoints": ["tcp/vehicle00:7447"]}
        assert world.zenoh("vehicle00")["connect"] == {"endpoints": []}
        assert world.zenoh("vehicle00")["listen"] == {"endpoints": ["tcp/0.0.0.0:7447"]}

    def test_a_rate_is_where_the_topic_is_taken_from(self) -> None:
        world = zenoh_world()
        world.send(demand("zenoh", {"/a": {"rate": 2.5}, "/b": {"rate": 1, "reverse": True}}))
        rates = {
            node: world.zenoh(node)["plugins"]["ros2dds"]["pub_max_frequencies"]
            for node in ("vehicle00", "edge")
        }
        assert rates == {"vehicle00": ["^/a$=2.5"], "edge": ["^/b$=1"]}

    def test_a_further_topic_restarts_both_bridges_and_no_other(self) -> None:
        world = zenoh_world()
        world.send(demand("zenoh", id="other", source="vehicle01"))
        world.send(demand("zenoh"))
        before = world.checksums()
        world.send(demand("zenoh", {"/b": "/b"}, requesters=["vehicle01"]))
        after = world.checksums()
        assert {name for name in after if after[name] != before[name]} == {
            "zenoh-edge",
            "zenoh-vehicle00",
        }

    def test_demands_in_any_order_leave_what_the_books_alone_would_give(self) -> None:
        chance = random.Random(7)
        world = zenoh_world()
        for _ in range(60):
            id = chance.choice("abc")
            source = {"a": "vehicle00", "b": "vehicle01", "c": "edge"}[id]
            target = "edge" if source != "edge" else "vehicle01"
            names = chance.sample(["/1", "/2", "/3"], chance.randrange(1, 4))
            topics = {f"/{id}{name[1:]}": {"reverse": id == "c"} for name in names}
            who = chance.choice(["vehicle00", "vehicle01"])
            asked = demand("zenoh", topics, id=id, source=source, target=target, requesters=[who])
            asked["shutdown"] = chance.random() < 0.5
            if asked["shutdown"] and not world.state.ledger.connection_claims(id):
                continue
            try:
                world.send(asked)
            except InvalidInput:
                continue  # the requester does not hold the connection
            kept = {path: text for path, text in world.files.items() if "ledger/" not in path}
            assert kept == rendered_files(world.state)


class TestRos:
    """A DDS router runs at each end of a connection."""

    def world(self, **more: Any) -> World:
        types = {"/a": "std_msgs/msg/String", "/b": "sensor_msgs/msg/PointCloud2"}
        return World(state(vehicle00={"types": types}, edge=WAN | TYPED, **more))

    def ends(self, world: World) -> dict[str, Any]:
        return {
            "source" if "-source" in name else "target": yaml.safe_load(data["config.yaml"])
            for name, data in world.clients().items()
        }

    def test_both_meet_at_the_targets_address(self) -> None:
        world = self.world()
        world.send(demand("ros"))
        ends = self.ends(world)
        (listening,) = ends["target"]["participants"][1]["listening-addresses"]
        (connecting,) = ends["source"]["participants"][1]["connection-addresses"]
        assert listening == connecting
        assert listening["ip"] == "192.0.2.1"
        assert 20000 <= listening["port"] <= 29999

    def test_or_at_the_sources_where_only_that_can_be_reached(self) -> None:
        named = {"wan": {"host": "vehicle00.example", "transport": "udp"}}
        world = World(state(vehicle00=named | TYPED))
        world.send(demand("ros"))
        ends = self.ends(world)
        (address,) = ends["source"]["participants"][1]["listening-addresses"]
        assert (address["domain"], address["transport"]) == ("vehicle00.example", "udp")
        assert "connection-addresses" in ends["target"]["participants"][1]

    def test_the_port_is_of_the_connection_alone(self) -> None:
        alone, second = self.world(), self.world()
        alone.send(demand("ros"))
        second.send(demand("ros", {"/b": "/b"}, id="before"))
        second.send(demand("ros"))
        assert alone.clients().items() <= second.clients().items()

    def test_a_further_topic_does_not_restart_a_router_but_an_option_does(self) -> None:
        world = self.world()
        world.send(demand("ros"))
        before = world.checksums()
        world.send(demand("ros", {"/b": "/b"}, requesters=["vehicle01"]))
        assert world.checksums() == before
        assert len(self.ends(world)["source"]["allowlist"]) == 2
        world.send(demand("ros", {"/c": {"type": "a/msg/B", "rate": 1}}, requesters=["station00"]))
        changed = {name for name, sum in world.checksums().items() if sum != before[name]}
        assert len(changed) == 1
        assert "-source" in changed.pop()


class TestMqtt:
    """Each end of a connection gets its own settings. ``tests/golden`` tests the options."""

    def test_a_connection_that_only_brings_back_has_its_ends_turned(self) -> None:
        world = World(state())
        world.send(demand("mqtt", {"/a": {"target": "/b", "reverse": True}}))
        ways = {
            name: yaml.safe_load(data["params.yaml"])["/**/*"]["ros__parameters"]["bridge"]
            for name, data in world.clients().items()
        }
        assert ways == {
            "mqtt-c-source": {
                "mqtt2ros": {"mqtt_topics": ["mqtt-c/a"], "mqtt-c/a": {"ros_topic": "/a"}}
            },
            "mqtt-c-target": {"ros2mqtt": {"ros_topics": ["/b"], "/b": {"mqtt_topic": "mqtt-c/a"}}},
        }

    def test_tls_without_a_secret_trusts_what_the_image_trusts(self) -> None:
        before = state()
        files = dict(skeleton())
        files["inventory/brokers.yaml"] += "    tls: {}\n"
        config = load({path: text for path, text in files.items() if "README" not in path})
        world = World(state_of(config, before.ledger))
        world.send(demand("mqtt"))
        for path, text in world.files.items():
            if "mqtt-" in path and path.startswith("clusters"):
                config, pod = yaml.safe_load_all(text)
                parameters = yaml.safe_load(config["data"]["params.yaml"])
                broker = parameters["/**/*"]["ros__parameters"]["broker"]
                assert broker["tls"] == {"enabled": True}
                (volume,) = pod["spec"]["template"]["spec"]["volumes"]
                assert volume["name"] == "config"


BRIDGED: dict[str, Any] = {"bridged": {"edge": ["/a"]}}


class TestBridgedAlready:
    """No client carries a topic that is bridged already, and each client has at least one topic."""

    @pytest.mark.parametrize("kind", ["mqtt", "zenoh", "ros"])
    def test_no_client_without_a_topic(self, kind: str) -> None:
        nodes = {"vehicle00": SPEAKS | TYPED | BRIDGED, "edge": REACHABLE | WAN | TYPED}
        world = World(state(**nodes))
        world.send(demand(kind))
        assert world.clients() == {}
        assert world.releases == ()
        assert len(world.state.ledger) == 1
        world.send(demand(kind, {"/b": {"type": "std_msgs/msg/String"}}))
        assert len(world.clients()) == 2
        assert not any("/a" in str(data).split("mqtt-c") for data in world.clients().values())

    def test_the_other_way_is_another_topic(self) -> None:
        world = World(state(vehicle00=BRIDGED))
        world.send(demand("mqtt", {"/a": {"reverse": True}}))
        assert len(world.clients()) == 2

    def test_another_name_is_not_carried_already(self) -> None:
        world = World(state(vehicle00=BRIDGED))
        world.send(demand("mqtt", {"/a": "/b"}))
        assert len(world.clients()) == 2


class TestWhatPeopleDidInGit:
    """A person edits a claim or the inventory so that the type cannot carry the connection."""

    NODES: ClassVar[dict[str, Any]] = {"vehicle00": SPEAKS | TYPED, "edge": REACHABLE | WAN}

    def faults_of(self, kind: str, route: Route, **nodes: Any) -> list[str]:
        """Render an edited claim with this route between these nodes; return the faults."""
        world = World(state(**self.NODES))
        world.send(demand(kind))
        (claim,) = world.state.ledger.connection_claims("c")
        edited = replace(claim, held=replace(claim.connection, topics=(route,)))
        books = world.state.ledger.replace(claim.key, edited)
        with pytest.raises(Refused) as refused:
            rendered_files(replace(state(**(self.NODES | nodes)), ledger=books))
        return [str(found) for found in refused.value.faults]

    def test_an_option_that_the_type_cannot_honour(self) -> None:
        assert self.faults_of("zenoh", Route("/a", "/a", qos=1)) == [
            "connections: 'c': qos of '/a' is not supported by ZENOH; leave it out, or use "
            "type MQTT"
        ]

    def test_another_name(self) -> None:
        (found,) = self.faults_of("ros", Route("/a", "/b"))
        assert found.startswith("connections: 'c': '/a' cannot become '/b'")

    @pytest.mark.parametrize(
        ("kind", "node", "left", "expected"),
        [
            ("zenoh", "vehicle00", {}, "node: 'vehicle00' carries Zenoh connections, but has no"),
            ("ros", "edge", {}, "connections: connection 'c' has no end with a wan address any"),
            ("ros", "vehicle00", {}, "connections: 'c': the message type of '/a' is not known"),
        ],
    )
    def test_what_the_inventory_lost(
        self, kind: str, node: str, left: dict[str, Any], expected: str
    ) -> None:
        assert self.faults_of(kind, Route("/a", "/a"), **{node: left})[0].startswith(expected)

    def test_an_image_that_the_registry_lost(self) -> None:
        world = World(state(**self.NODES))
        world.send(demand("zenoh"))
        with pytest.raises(Refused, match="'zenoh-bridge' is in use, but not in registry/images"):
            rendered_files(replace(state("", **self.NODES), ledger=world.state.ledger))


@pytest.mark.parametrize("kind", ["mqtt", "zenoh", "ros"])
def test_the_schema_of_a_client_program_knows_each_field_and_no_other(kind: str) -> None:
    world = World(state(**{"vehicle00": SPEAKS | TYPED, "edge": REACHABLE | WAN}))
    world.send(demand(kind))
    for data in world.clients().values():
        (text,) = data.values()
        whole = yaml.safe_load(text)
        assert not schema_faults(kind, whole)
        for spot in _mappings(whole):
            spot["surplus"] = 1
            assert schema_faults(kind, whole)
            del spot["surplus"]


def _mappings(value: Any) -> list[dict[str, Any]]:
    if isinstance(value, dict):
        return [value, *(found for item in value.values() for found in _mappings(item))]
    if isinstance(value, list):
        return [found for item in value for found in _mappings(item)]
    return []
