"""The communication clients of claimed connections.

MQTT and ROS connections have a client of their own at each end. Zenoh connections share one bridge
on each node, because two bridges on one host and ROS domain do not work.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Literal

from demandops.config.config import Config
from demandops.config.inventory import Node
from demandops.demand import route as routes
from demandops.demand.claim import ConnectionClaim, Subject, SubjectKind
from demandops.demand.connection_type_choice import choose_broker, message_type, route_faults
from demandops.demand.demand_request import ConnectionType
from demandops.demand.route import Route
from demandops.errors import Fault, Refused, fault
from demandops.ledger.ledger import Ledger
from demandops.plan import naming
from demandops.plan.release import Address, Bridge, MqttEnd, RosEnd, node_and_domain

Side = Literal["source", "target"]


@dataclass(frozen=True, slots=True)
class EndKey:
    """One end of an MQTT or ROS connection."""

    connection: str
    side: Side


@dataclass(frozen=True, slots=True)
class BridgeKey:
    """The Zenoh bridge of a node."""

    node: str


def client_keys(ledger: Ledger, connection: str) -> Iterator[EndKey | BridgeKey]:
    """Yield the keys of the clients that a connection needs."""
    first = ledger.first_claim(Subject(SubjectKind.CONNECTION, connection))
    if not isinstance(first, ConnectionClaim):
        return
    if first.type is ConnectionType.ZENOH:
        yield BridgeKey(first.source)
        yield BridgeKey(first.target)
        return
    yield EndKey(connection, "source")
    yield EndKey(connection, "target")


def connection_topics(claims: Iterable[ConnectionClaim]) -> dict[str, Route]:
    """Return the routes of all claims on a connection by source topic, sorted."""
    return routes.merge_routes(route for claim in claims for route in claim.topics.values())


def is_bridged(route: Route, source: str, target: str, config: Config) -> bool:
    """Return whether the initial deployment already carries a topic between two ends.

    It keeps topic names, so it does not carry a route that renames the topic.
    """
    sender, receiver = route.sender_and_receiver(source, target)
    node = config.nodes.get(sender)
    if node is None or route.source != route.target:
        return False
    return route.read_topic in node.bridged.get(receiver, ())


def carried_routes(claims: tuple[ConnectionClaim, ...], config: Config) -> dict[str, Route]:
    """Return the routes that a connection's clients must carry: those not bridged already.

    Raises:
        Refused: if a person wrote a claim that its type cannot carry, or removed what it needs from
            the inventory.
    """
    first = claims[0]
    topics = {
        name: route
        for name, route in connection_topics(claims).items()
        if not is_bridged(route, first.source, first.target, config)
    }
    problems = list(route_faults(first.type, topics.values(), (first.source, first.target), config))
    if problems:
        raise Refused(
            replace(one, field="connections", message=f"'{first.connection}': {one.message}")
            for one in problems
        )
    return topics


def connection_end(ledger: Ledger, config: Config, key: EndKey) -> MqttEnd | RosEnd | None:
    """Return one end of a connection, or ``None`` if it carries no topic.

    Raises:
        Refused: if the configuration no longer has what the connection needs.
    """
    claims = ledger.connection_claims(key.connection)
    if not claims or claims[0].type is ConnectionType.ZENOH:
        return None
    topics = carried_routes(claims, config)
    if not topics:
        return None
    if claims[0].type is ConnectionType.MQTT:
        return _mqtt_end(claims, config, key, topics)
    return _ros_end(ledger, config, key, topics)


def _mqtt_end(
    claims: tuple[ConnectionClaim, ...], config: Config, key: EndKey, topics: dict[str, Route]
) -> MqttEnd:
    first = claims[0]
    named = next((claim.broker for claim in claims if claim.broker), "")
    broker = choose_broker(named, first.source, first.target, config)
    if broker is None:
        raise Refused(
            [
                fault(
                    "broker",
                    f"connection '{key.connection}' has no broker; add one to "
                    "inventory/brokers.yaml",
                    code="no-broker",
                )
            ]
        )
    own, peer = _own_and_peer(first, key)
    node, domain = node_and_domain(config, own)
    return MqttEnd(
        connection=key.connection,
        side=key.side,
        name=naming.object_name("mqtt", key.connection, key.side),
        node=node,
        peer=peer,
        domain=domain,
        topics=MappingProxyType(topics),
        broker=broker,
        channel=naming.object_name("mqtt", key.connection),
    )


def _own_and_peer(claim: ConnectionClaim, key: EndKey) -> tuple[str, str]:
    ends = (claim.source, claim.target)
    return ends if key.side == "source" else (ends[1], ends[0])


def _ros_end(ledger: Ledger, config: Config, key: EndKey, topics: dict[str, Route]) -> RosEnd:
    claim = ledger.connection_claims(key.connection)[0]
    ends = (claim.source, claim.target)
    typed = {
        name: replace(route, type=message_type(route, route.sender_and_receiver(*ends)[0], config))
        for name, route in topics.items()
    }
    listener = _listener(claim, config)
    if listener is None:
        raise _unsupported(key.connection, "has no end with a wan address any longer; restore one")
    address = _address(key.connection, listener)
    for other in ledger.connections_at(ConnectionType.ROS, listener.id):
        if other == key.connection or _address(other, listener) != address:
            continue
        if _listener(ledger.connection_claims(other)[0], config) is listener:
            raise _unsupported(
                key.connection,
                f"would listen on port {address.port} of '{listener.id}', as '{other}' does; use "
                "another connection id, or widen firstPort and lastPort of its wan",
            )
    own, peer = _own_and_peer(claim, key)
    node, domain = node_and_domain(config, own)
    return RosEnd(
        connection=key.connection,
        side=key.side,
        name=naming.object_name("ros", key.connection, key.side),
        node=node,
        peer=peer,
        domain=domain,
        topics=MappingProxyType(typed),
        listens=own == listener.id,
        address=address,
    )


def _unsupported(connection: str, reason: str) -> Refused:
    message = f"connection '{connection}' {reason}"
    return Refused([fault("connections", message, code="unsupported-connection-type")])


def _listener(claim: ConnectionClaim, config: Config) -> Node | None:
    """Return the end that the other connects to: the target if it has a wan address."""
    for id in (claim.target, claim.source):
        node = config.nodes.get(id)
        if node is not None and node.wan is not None:
            return node
    return None


def _address(connection: str, listener: Node) -> Address:
    """Return the address of a connection's routers; its port depends on the connection id only."""
    wan = listener.wan
    assert wan is not None  # noqa: S101 - a listener has one
    ports = wan.last_port - wan.first_port + 1
    return Address(wan.host, wan.first_port + _number(connection) % ports, wan.transport)


@lru_cache(maxsize=65_536)
def _number(connection: str) -> int:
    """Return a number for a connection id; cached, because all ids of a node are compared."""
    return int(naming.digest("port", connection), 16)


def zenoh_bridge(ledger: Ledger, config: Config, key: BridgeKey) -> Bridge | None:
    """Return a node's Zenoh bridge, or ``None`` if no connection needs it.

    Raises:
        Refused: if two connections ask for different rates of one topic, or the configuration no
            longer has what they need.
    """
    publishers: dict[str, tuple[float, str]] = {}
    subscribers: set[str] = set()
    connections: dict[str, str] = {}
    for id in ledger.connections_at(ConnectionType.ZENOH, key.node):
        claims = ledger.connection_claims(id)
        source, target = claims[0].source, claims[0].target
        for route in carried_routes(claims, config).values():
            connections[id] = target if key.node == source else source
            if key.node != route.sender_and_receiver(source, target)[0]:
                subscribers.add(route.written_topic)
                continue
            rate, other = publishers.setdefault(route.read_topic, (route.rate, id))
            if rate != route.rate:
                raise Refused([_two_rates(route, id, rate, other, key.node)])
    if not connections:
        return None
    node, domain = node_and_domain(config, key.node)
    return Bridge(
        name=naming.object_name("zenoh", key.node),
        node=node,
        domain=domain,
        connections=tuple(connections),
        publishers=tuple(sorted(publishers)),
        subscribers=tuple(sorted(subscribers)),
        rates=MappingProxyType({t: rate for t, (rate, _) in sorted(publishers.items()) if rate}),
        connect=_connect(node, set(connections.values()), config),
        listen=node.zenoh.listening() if node.zenoh else (),
    )


def _two_rates(route: Route, id: str, rate: float, other: str, node: str) -> Fault:
    return fault(
        "connections",
        f"rate {route.rate} of '{route.read_topic}' in '{id}' contradicts an existing claim: "
        f"'{other}' carries it from '{node}' with rate {rate}, and the node's bridge has one for "
        "each topic; use the same",
        code="conflict",
    )


def _connect(node: Node, peers: set[str], config: Config) -> tuple[str, ...]:
    """Return the endpoints that a bridge connects to: its routers, and some of its peers.

    If two peers can reach each other, only the one whose id sorts first connects. So there is one
    link between them.
    """
    if node.zenoh is None:
        raise Refused(
            [
                fault(
                    "node",
                    f"'{node.id}' carries Zenoh connections, but has no zenoh in "
                    "inventory/nodes.yaml any longer; restore it",
                    code="unsupported-connection-type",
                )
            ]
        )
    endpoints = set(node.zenoh.connect)
    for id in peers:
        peer = config.nodes.get(id)
        endpoint = peer.zenoh.endpoint if peer and peer.zenoh else None
        if endpoint and (not node.zenoh.endpoint or node.id < id):
            endpoints.add(endpoint)
    return tuple(sorted(endpoints))
