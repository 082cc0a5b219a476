"""A fourth connection type needs one module, its templates, and an entry in the list of types.

This test module is that module, and ``relay/`` has the templates. Its client is a relay, which runs
at the target and fetches the topics of all sources. Although nothing else in the program knows the
type, demands for connections of this type are booked, planned, rendered and explained.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base import naming, settings
from demandops.base.errors import Fault, fault
from demandops.base.naming import Subject, SubjectKind
from demandops.connections import connection_types
from demandops.connections.connection import (
    Client,
    ClientKey,
    Connection,
    Connections,
    ConnectionType,
)
from demandops.decide.decision import Decision
from demandops.decide.planning.planner import keys_of, plan
from demandops.model.config.config import NODES_FILE, Config
from demandops.model.ledger import claim as claim_files
from demandops.templating import engine
from demandops.views.source import claims_behind
from demandops.views.why import shaping_files

from tests.kit.connections import ROS_IMAGE, demand, routes, state
from tests.kit.goals import connection, goal
from tests.kit.memory import MemoryRepo

RELAY_TEMPLATES = Path(__file__).parent / "relay"


class RelayType(ConnectionType):
    """A connection type with one client at the target, for the topics of all its connections."""

    name, word = "RELAY", "relay"
    number = 7
    image = "relay"
    options = frozenset({"queue"})
    renames = True

    def link_faults(self, connection: Connection, config: Config) -> Iterator[Fault]:
        target = config.nodes.get(connection.target)
        if target is not None and target.wan is None:
            yield fault("target", f"'{target.id}' has no wan; add it in {NODES_FILE}")

    def keys(self, connection: str, source: str, target: str) -> Iterable[ClientKey]:
        return (ClientKey(self, target),)

    def client(self, key: ClientKey, connections: Connections, config: Config) -> Client | None:
        found = [one for id in connections.at(key.id) if (one := connections.get(id))]
        carried = [one for one in found if one.target == key.id and one.topics]
        fetch = {r.read_topic: r.written_topic for one in carried for r in one.topics}
        node, domain = config.node_and_domain(key.id)
        name = naming.object_name(self.word, key.id)
        ids = tuple(one.id for one in carried)
        return Relay(self, name, node, domain, ids, fetch) if carried else None


@dataclass(frozen=True, slots=True)
class Relay(Client):
    """The relay of a node; ``fetch`` maps each topic at its source to its name at the node."""

    fetch: dict[str, str]

    @property
    def description(self) -> str:
        return f"relay on {self.node.id}"

    def facts(self) -> list[str]:
        return [f"fetches {topic} as {name}" for topic, name in self.fetch.items()]

    def shaping_entries(self, config: Config) -> Iterable[tuple[str, str, str]]:
        yield NODES_FILE, f"{self.node.id}.wan", "where it can be reached"

    def configuration(self) -> dict[str, Any]:
        return {"fetch": self.fetch}


RELAY = RelayType()


@pytest.fixture(autouse=True)
def a_fourth_type(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    shutil.copytree(settings.data_folder("templates"), tmp_path / "templates")
    shutil.copytree(RELAY_TEMPLATES, tmp_path / "templates" / "connections" / "relay")
    for name in ("appdefs", "state-repo-skeleton"):
        (tmp_path / name).symlink_to(settings.data_folder(name))
    monkeypatch.setattr(settings, "_CHECKOUT", tmp_path)
    types = (*connection_types.CONNECTION_TYPES, RELAY)
    monkeypatch.setattr(connection_types, "CONNECTION_TYPES", types)
    engine._own.cache_clear()
    yield
    engine._own.cache_clear()


def repo() -> MemoryRepo:
    images = ROS_IMAGE + "  relay: {repository: registry.example/relay, tag: '1'}\n"
    before = state(images, brokers=False, edge={"wan": {"host": "192.0.2.1"}})
    return MemoryRepo(state=before)


def booked(kind: str = "relay") -> tuple[MemoryRepo, Decision]:
    world = repo()
    return world, world.send(routes(demand(kind, {"/a": {"target": "/b", "queue": 3}})))


@pytest.mark.parametrize("kind", ["relay", "auto"])
def test_a_demand_for_it_becomes_a_claim_and_a_client(kind: str) -> None:
    """Without a type, it is chosen because no other can carry the topic."""
    world, decision = booked(kind)
    (claim,) = world.state.ledger.connection_claims("c")
    assert claim.connection.type is RELAY
    path = claim_files.path_of(claim.key)
    assert yaml.safe_load(world.files[path])["connection"]["type"] == "relay"
    assert claim_files.read(world.files[path], path) == claim
    assert world.objects("Deployment").keys() == {"relay-edge"}
    (config,) = world.objects("ConfigMap").values()
    assert yaml.safe_load(config["data"]["relay.yaml"]) == {"fetch": {"/a": "/b"}}
    (release,) = decision.releases
    assert (release.change, release.what) == ("start", "relay on edge")


def test_people_are_told_what_it_is_for_and_what_shapes_it() -> None:
    world, _ = booked()
    ledger = world.state.ledger
    subject = Subject(SubjectKind.CONNECTION, "c")
    (release,) = (plan(world.state, key) for key in keys_of(world.state, subject))
    assert claims_behind(ledger, release) == [*ledger.claims_on(subject)]
    files = [each[:2] for each in shaping_files(release, world.config)]
    assert ("inventory/nodes.yaml", "edge.wan") in files
    assert ("registry/images.yaml", "images.relay") in files


def test_its_number_is_known_on_the_wire() -> None:
    world = repo()
    assert world.send(goal([], [connection("c", topics=["/a"], broker="", type=7)])).releases
    (found,) = world.faults(goal([], [connection("d", topics=["/a"], broker="", type=9)]))
    assert found.endswith("known: 0 (ROS), 1 (MQTT), 2 (ZENOH), 7 (RELAY)")


def test_what_it_cannot_do_is_refused_and_others_name_it() -> None:
    link, option = repo().faults(routes(demand("relay", {"/a": {"qos": 1}}, target="cloud")))
    assert link.startswith("connections[0].target: 'cloud' has no wan")
    assert option.startswith("connections[0].topics[0].qos: qos of '/a' is not supported by RELAY")
    found = repo().faults(routes(demand("ros", {"/a": {"target": "/b"}})))
    assert any(one.endswith("or use type MQTT or RELAY") for one in found)
