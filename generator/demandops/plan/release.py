"""Releases: the plan's result, one for each service instance and communication client."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from demandops.config.appdef import Service
from demandops.config.config import DOMAINS_FILE, NODES_FILE, Config
from demandops.config.inventory import Broker, Node
from demandops.config.override import Override
from demandops.config.policy import AccessDomain
from demandops.config.registry import ChartSource, Image
from demandops.connections.route import Route
from demandops.demand.demand_request import ConnectionType, InputTopic
from demandops.errors import Refused, fault


@dataclass(frozen=True, slots=True)
class ServiceKey:
    """One instance of a service.

    ``application`` is set if the service runs once for each application. ``source`` and ``topic``
    are set if it runs once for each topic; all applications that use the topic share it.
    """

    service: str
    node: str
    application: str | None = None
    source: str | None = None
    topic: str | None = None


@dataclass(frozen=True, slots=True)
class Shaping:
    """The overrides that shape a release, with the effects of each; the last one wins."""

    by: tuple[tuple[Override, tuple[str, ...]], ...] = ()

    def image(self, image: str, config: Config) -> Image:
        """Return an image of the registry, with the pins of overrides."""
        found = config.images[image]
        for override, effects in self.by:
            if "images" in effects and override.images and image in override.images:
                found = override.images[image].over(found)
        return found

    @property
    def patches(self) -> tuple[tuple[str, Mapping[str, Any]], ...]:
        """The files that patch values, and their patches."""
        return tuple(
            (override.path, override.values or {})
            for override, effects in self.by
            if "values" in effects
        )

    @property
    def held(self) -> bool:
        """Whether a ``hold`` applies that no higher override changes, so the file stays."""
        held = False
        for _, effects in self.by:
            held = "hold" in effects or (held and set(effects) <= {"keep"})
        return held


UNSHAPED = Shaping()


@dataclass(frozen=True, slots=True)
class ServiceRelease:
    """The desired state of one service: one Helm release."""

    key: ServiceKey
    name: str
    node: Node
    domain: AccessDomain
    appdef: str
    service: Service
    chart: ChartSource
    inputs: Mapping[str, tuple[InputTopic, ...]]
    outputs: Mapping[str, str]
    parameters: Mapping[str, object]
    replicas: int
    applications: tuple[str, ...]
    requesters: tuple[str, ...]
    shaping: Shaping = UNSHAPED


@dataclass(frozen=True, slots=True)
class ConnectionEnd:
    """The desired state of one end of a connection: one communication client."""

    type: ClassVar[ConnectionType]

    connection: str
    side: Literal["source", "target"]
    name: str
    node: Node
    peer: str
    domain: AccessDomain
    topics: Mapping[str, Route]
    shaping: Shaping = field(default=UNSHAPED, kw_only=True)

    def reads(self, route: Route) -> bool:
        """Return whether this end reads the topic from ROS, and the other end publishes it."""
        return route.reverse is (self.side == "target")


@dataclass(frozen=True, slots=True)
class MqttEnd(ConnectionEnd):
    """One end of an MQTT connection."""

    type = ConnectionType.MQTT

    broker: Broker
    channel: str
    """The prefix of this connection's MQTT topics, the same at both ends."""


@dataclass(frozen=True, slots=True)
class RosEnd(ConnectionEnd):
    """One end of a ROS connection. Every route of ``topics`` has its message type."""

    type = ConnectionType.ROS

    listens: bool
    address: Address
    """The address of the end that listens, the same at both ends."""


@dataclass(frozen=True, slots=True)
class Address:
    """The host and port at which one DDS Router listens for the other."""

    host: str
    port: int
    transport: str


@dataclass(frozen=True, slots=True)
class Bridge:
    """The desired state of a node's Zenoh bridge, which serves all its Zenoh connections.

    ``publishers`` are the topics that it reads from the node's ROS graph, ``subscribers`` those
    that it publishes there. ``rates`` limits the messages per second of a topic that it reads.
    """

    name: str
    node: Node
    domain: AccessDomain
    connections: tuple[str, ...]
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    rates: Mapping[str, float]
    connect: tuple[str, ...]
    listen: tuple[str, ...]
    shaping: Shaping = UNSHAPED


Release = ServiceRelease | MqttEnd | RosEnd | Bridge


def node_and_domain(config: Config, node_id: str) -> tuple[Node, AccessDomain]:
    """Return a node and its access domain.

    Raises:
        Refused: if a node in use was removed from the inventory or its access domain.
    """
    node, domain = config.nodes.get(node_id), config.domain_of.get(node_id)
    if node is None or domain is None:
        missing = NODES_FILE if node is None else "any access domain"
        raise Refused(
            [
                fault(
                    "node",
                    f"'{node_id}' is in use, but not in {missing}; restore it, or release "
                    f"what it holds: demandops decommission {shlex.quote(node_id)}",
                    code="unknown-node",
                ).within(NODES_FILE if node is None else DOMAINS_FILE)
            ]
        )
    return node, domain
