"""From claims on connections to communication clients.

MQTT and ROS connections have a client of their own at each end. Zenoh connections share one
bridge on each node, for two on one host and ROS domain do not work.
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
from demandops.demand.claim import ConnectionClaim
from demandops.demand.demand_request import ConnectionType
from demandops.demand.route import Route
from demandops.demand.transport_choice import choose_broker, message_type, route_faults
from demandops.errors import Fault, Refused, fault
from demandops.ledger.apply import Ledger
from demandops.plan import naming
from demandops.plan.release import Address, Bridge, MqttEnd, RosEnd, place

Side = Literal["source", "target"]


@dataclass(frozen=True, slots=True)
class EndKey:
    """One end of a connection that has clients of its own."""

    connection: str
    side: Side


@dataclass(frozen=True, slots=True)
class BridgeKey:
    """The Zenoh bridge of a node."""

    node: str


def keys_of(ledger: Ledger, connection: str) -> Iterator[EndKey | BridgeKey]:
    """Yield the clients that run because a connection is held."""
    claims = ledger.connection(connection)
    if not claims:
        return
    if claims[0].type is ConnectionType.ZENOH:
        yield BridgeKey(claims[0].source)
        yield BridgeKey(claims[0].target)
        return
    yield EndKey(connection, "source")
    yield EndKey(connection, "target")


def connection_topics(claims: Iterable[ConnectionClaim]) -> dict[str, Route]:
    """Return the routes by source topic, united over a connection's claims and sorted."""
    return routes.merge_routes(route for claim in claims for route in claim.topics.values())


def is_bridged(route: Route, source: str, target: str, config: Config) -> bool:
    """Tell whether the initial deployment carries a topic between two ends already.

    It keeps names, so a route that gives the topic another name is not carried by it.
    """
    giving, taking = route.sender_and_receiver(source, target)
    node = config.nodes.get(giving)
    if node is None or route.source != route.target:
        return False
    return route.read_topic in node.bridged.get(taking, ())


def carried(claims: tuple[ConnectionClaim, ...], config: Config) -> dict[str, Route]:
    """Return the routes that a connection's clients must carry: those not bridged already.

    Raises:
        Refused: where a person wrote a claim that its type cannot carry, or took out of the
            inventory what it needs.
    """
    first = claims[0]
    topics = {
        name: route
        for name, route in connection_topics(claims).items()
        if not is_bridged(route, first.source, first.target, config)
    }
    found = list(route_faults(first.type, topics.values(), (first.source, first.target), config))
    if found:
        raise Refused(
            replace(one, field="connections", message=f"'{first.connection}': {one.message}")
            for one in found
        )
    return topics


def end(ledger: Ledger, config: Config, key: EndKey) -> MqttEnd | RosEnd | None:
    """Return one end of a connection, or nothing where it carries no topic.

    Raises:
        Refused: where the configuration no longer has what the connection needs.
    """
    claims = ledger.connection(key.connection)
    if not claims or claims[0].type is ConnectionType.ZENOH:
        return None
    topics = carried(claims, config)
    if not topics:
        return None
    if claims[0].type is ConnectionType.MQTT:
        return _mqtt_end(claims, config, key, topics)
    return _ros_end(ledger, config, key, topics)


def _mqtt_end(
    claims: tuple[ConnectionClaim, ...], config: Config, key: EndKey, topics: dict[str, Route]
) -> MqttEnd:
    first = claims[0]
    wanted = next((claim.broker for claim in claims if claim.broker), "")
    broker = choose_broker(wanted, first.source, first.target, config)
    if broker is None:
        raise Refused(
            [
                fault(
                    "broker",
                    f"connection '{key.connection}' finds no broker; add one to "
                    "inventory/brokers.yaml",
                    code="no-broker",
                )
            ]
        )
    own, peer = _own_and_peer(first, key)
    node, domain = place(config, own)
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
    claim = ledger.connection(key.connection)[0]
    ends = (claim.source, claim.target)
    typed = {
        name: replace(route, type=message_type(route, route.sender_and_receiver(*ends)[0], config))
        for name, route in topics.items()
    }
    listener = _listener(claim, config)
    if listener is None:
        raise _stuck(key.connection, "finds no end with a wan address any more; restore it")
    address = _address(key.connection, listener)
    for other in ledger.at(ConnectionType.ROS, listener.id):
        if other == key.connection or _address(other, listener) != address:
            continue
        if _listener(ledger.connection(other)[0], config) is listener:
            raise _stuck(
                key.connection,
                f"would listen on port {address.port} of '{listener.id}', as '{other}' does; use "
                "another connection id, or widen firstPort and lastPort of its wan",
            )
    own, peer = _own_and_peer(claim, key)
    node, domain = place(config, own)
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


def _stuck(connection: str, reason: str) -> Refused:
    message = f"connection '{connection}' {reason}"
    return Refused([fault("connections", message, code="unsupported-connection-type")])


def _listener(claim: ConnectionClaim, config: Config) -> Node | None:
    """Return the end that the other connects to: the target where it can be reached."""
    for id in (claim.target, claim.source):
        node = config.nodes.get(id)
        if node is not None and node.wan is not None:
            return node
    return None


def _address(connection: str, listener: Node) -> Address:
    """Return where a connection's routers meet: a port that follows from its id alone."""
    wan = listener.wan
    assert wan is not None  # noqa: S101 - that makes it the listener
    ports = wan.last_port - wan.first_port + 1
    return Address(wan.host, wan.first_port + _number(connection) % ports, wan.transport)


@lru_cache(maxsize=65_536)
def _number(connection: str) -> int:
    """Return a number of a connection's id; kept, for all that share a node are compared."""
    return int(naming.digest("port", connection), 16)


def bridge(ledger: Ledger, config: Config, key: BridgeKey) -> Bridge | None:
    """Return a node's Zenoh bridge, or nothing where no connection needs it.

    Raises:
        Refused: where two connections want different rates of one topic, or the configuration no
            longer has what they need.
    """
    publishers: dict[str, tuple[float, str]] = {}
    subscribers: set[str] = set()
    connections: dict[str, str] = {}
    for id in ledger.at(ConnectionType.ZENOH, key.node):
        claims = ledger.connection(id)
        source, target = claims[0].source, claims[0].target
        for route in carried(claims, config).values():
            connections[id] = target if key.node == source else source
            if key.node != route.sender_and_receiver(source, target)[0]:
                subscribers.add(route.written_topic)
                continue
            rate, other = publishers.setdefault(route.read_topic, (route.rate, id))
            if rate != route.rate:
                raise Refused([_two_rates(route, id, rate, other, key.node)])
    if not connections:
        return None
    node, domain = place(config, key.node)
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
        f"rate {route.rate} of '{route.read_topic}' in '{id}' contradicts what stands: '{other}' "
        f"carries it from '{node}' with rate {rate}, and the node's bridge has one for each topic; "
        "use the same",
        code="conflict",
    )


def _connect(node: Node, peers: set[str], config: Config) -> tuple[str, ...]:
    """Return where a bridge connects to: its routers, and peers that do not connect to it.

    Of two that can both be reached, the one whose id comes first connects, so that there is one
    link between them whatever they carry.
    """
    if node.zenoh is None:
        raise Refused(
            [
                fault(
                    "node",
                    f"'{node.id}' carries Zenoh connections, but has no zenoh in "
                    "inventory/nodes.yaml any more; restore it",
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
