"""The choice of a connection type: which types can carry a connection in this configuration.

:func:`type_faults` yields why a type cannot carry a connection. :func:`with_chosen_types` chooses
the type of each connection that leaves it open.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from demandops.config.config import (
    DDS_ROUTER_IMAGE,
    IMAGES_FILE,
    MQTT_CLIENT_IMAGE,
    NODES_FILE,
    ZENOH_BRIDGE_IMAGE,
    Config,
)
from demandops.config.inventory import Broker, Node
from demandops.connections.route import Route
from demandops.demand.demand_request import ConnectionDemand, ConnectionType, DemandRequest
from demandops.errors import Fault, fault, quoted
from demandops.identifiers import topic_problem

PREFERENCE = (ConnectionType.ZENOH, ConnectionType.MQTT, ConnectionType.ROS)
"""The order of the automatic choice."""

SUPPORTED_OPTIONS: dict[ConnectionType, frozenset[str]] = {
    ConnectionType.MQTT: frozenset(
        {"qos", "retained", "primitive", "reliability", "durability", "queue"}
    ),
    ConnectionType.ZENOH: frozenset({"rate"}),
    ConnectionType.ROS: frozenset({"reliability", "durability", "queue", "rate"}),
}
"""The options of a route that a type supports; all support message type and direction."""

_IMAGES = {
    ConnectionType.MQTT: MQTT_CLIENT_IMAGE,
    ConnectionType.ZENOH: ZENOH_BRIDGE_IMAGE,
    ConnectionType.ROS: DDS_ROUTER_IMAGE,
}
_ALWAYS = ("type", "reverse")
_UNSUPPORTED = "unsupported-connection-type"

CurrentType = Callable[[str], ConnectionType | None]
"""Returns the type of a connection that is already claimed, or ``None``."""


def with_chosen_types(
    request: DemandRequest, config: Config, current_type: CurrentType
) -> DemandRequest:
    """Return ``request`` with a chosen type for each connection of type ``AUTO``.

    A claimed connection keeps its current type. Another gets the first of Zenoh, MQTT and ROS that
    can carry it (:func:`type_faults`); it stays ``AUTO`` if none can.
    """
    connections = tuple(
        replace(
            connection, type=(current_type(connection.id) or choose_type(connection, config)).value
        )
        if connection.type == ConnectionType.AUTO.value
        else connection
        for connection in request.connections
    )
    return replace(request, connections=connections)


def choose_type(connection: ConnectionDemand, config: Config) -> ConnectionType:
    """Return the type for a connection that leaves it open; ``AUTO`` if none can carry it."""
    for kind in PREFERENCE:
        if next(type_faults(kind, connection, config), None) is None:
            return kind
    return ConnectionType.AUTO


def no_type_fault(connection: ConnectionDemand, config: Config) -> Fault:
    """Return a fault that says for each type why it cannot carry a connection."""
    reasons = []
    for kind in PREFERENCE:
        reason = next(type_faults(kind, connection, config))
        field = "" if reason.field == "type" else f"{reason.field} "
        reasons.append(f"{kind.name}: {field}{reason.message}")
    message = f"is not given, and no type can carry it. {'; '.join(reasons)}"
    return fault("type", message, code=_UNSUPPORTED)


def type_faults(
    kind: ConnectionType, connection: ConnectionDemand, config: Config
) -> Iterator[Fault]:
    """Yield why ``kind`` cannot carry a connection, by fields of :class:`ConnectionDemand`.

    Nodes that are not in the inventory are skipped; :mod:`demandops.demand.admission` reports them.
    """
    if kind is not ConnectionType.MQTT and _IMAGES[kind] not in config.images:
        yield fault(
            "type",
            f"{kind.value} ({kind.name}) needs an image '{_IMAGES[kind]}'; add it to {IMAGES_FILE}",
            code=_UNSUPPORTED,
        )
    yield from _end_faults(kind, connection, config)
    yield from route_faults(kind, connection.topics, (connection.source, connection.target), config)


def route_faults(
    kind: ConnectionType, topics: Iterable[Route], ends: tuple[str, str], config: Config
) -> Iterator[Fault]:
    """Yield a fault for everything in a connection's routes that ``kind`` does not support."""
    for index, route in enumerate(topics):
        if topic_problem(route.source) or topic_problem(route.target):
            continue  # the request's own checks report it
        where = f"topics[{index}]"
        yield from _option_faults(where, kind, route)
        if kind is ConnectionType.ROS:
            yield from _ros_route_faults(where, route, route.sender_and_receiver(*ends)[0], config)
        if kind is not ConnectionType.MQTT and route.source != route.target:
            yield fault(
                f"{where}.target",
                f"'{route.source}' cannot become '{route.target}': {kind.name} keeps the name; "
                "use one name, or type 1 (MQTT)",
            )


def _end_faults(
    kind: ConnectionType, connection: ConnectionDemand, config: Config
) -> Iterator[Fault]:
    source, target = config.nodes.get(connection.source), config.nodes.get(connection.target)
    if kind is ConnectionType.MQTT:
        # without a broker in the request it follows from the ends; admission reports unknown ends
        known = connection.broker or (source and target)
        if (
            known
            and choose_broker(connection.broker, connection.source, connection.target, config)
            is None
        ):
            yield _no_broker(connection, config)
        return
    if connection.broker:
        yield fault("broker", f"is for MQTT only, and the type is {kind.name}; leave it out")
    if source is None or target is None:
        return
    for end, node in (("source", source), ("target", target)):
        if node.ros.rmw == "rmw_zenoh_cpp":
            yield fault(
                end,
                f"'{node.id}' runs rmw_zenoh_cpp, and {kind.name} clients speak DDS; use type 1 "
                f"(MQTT), or another rmw in {NODES_FILE}",
                code=_UNSUPPORTED,
            )
    if kind is ConnectionType.ROS:
        if source.wan is None and target.wan is None:
            yield fault(
                "type",
                f"0 (ROS) needs an end with a reachable address; add wan: {{host: …}} to "
                f"'{source.id}' or '{target.id}' in {NODES_FILE}",
                code=_UNSUPPORTED,
            )
        return
    yield from _zenoh_end_faults(source, target)


def _zenoh_end_faults(source: Node, target: Node) -> Iterator[Fault]:
    for end, node in (("source", source), ("target", target)):
        if node.zenoh is None:
            yield fault(
                end,
                f"'{node.id}' runs no Zenoh bridge; add zenoh: {{endpoint: …}} to it in "
                f"{NODES_FILE}, or zenoh: {{}} if it can reach others",
                code=_UNSUPPORTED,
            )
    if source.zenoh is None or target.zenoh is None:
        return
    reachable = source.zenoh.endpoint or target.zenoh.endpoint
    if source.id != target.id and not (
        reachable or set(source.zenoh.connect) & set(target.zenoh.connect)
    ):
        yield fault(
            "type",
            f"2 (ZENOH) finds no route between '{source.id}' and '{target.id}'; give one of them "
            f"an endpoint under zenoh in {NODES_FILE}, or both one router under connect",
            code=_UNSUPPORTED,
        )


def _option_faults(where: str, kind: ConnectionType, route: Route) -> Iterator[Fault]:
    for name in route.options():
        if name in _ALWAYS or name in SUPPORTED_OPTIONS[kind]:
            continue
        able = [other for other in PREFERENCE if name in SUPPORTED_OPTIONS[other]]
        names = " or ".join(f"{other.value} ({other.name})" for other in able)
        yield fault(
            f"{where}.{name}",
            f"{name} of '{route.source}' is not supported by {kind.name}; leave it out, or use "
            f"type {names}",
        )


def _ros_route_faults(where: str, route: Route, node: str, config: Config) -> Iterator[Fault]:
    if node in config.nodes and not message_type(route, node, config):
        yield fault(
            f"{where}.type",
            f"the message type of '{route.source}' is not known, and ROS needs it; give it in "
            f"the request if it has a field for it, or add it to types of '{node}' in {NODES_FILE}",
        )
    if route.durability and not route.reliability:
        yield fault(
            f"{where}.reliability",
            f"is not given, but durability of '{route.source}' is set; ROS needs both, add it",
        )


def message_type(route: Route, node: str, config: Config) -> str:
    """Return the message type of a route with sender ``node``, from the route or the inventory."""
    known = config.nodes.get(node)
    return route.type or (known.types.get(route.read_topic, "") if known else "")


def choose_broker(requested: str, source: str, target: str, config: Config) -> Broker | None:
    """Return a connection's broker: the requested, the target's, the source's or the only one.

    Return ``None`` if there is none of these. ``requested`` is a node id or empty.
    """
    if requested:
        return config.brokers.get(requested)
    for node in (target, source):
        if node in config.brokers:
            return config.brokers[node]
    if len(config.brokers) == 1:
        return next(iter(config.brokers.values()))
    return None


def _no_broker(connection: ConnectionDemand, config: Config) -> Fault:
    known = ", ".join(sorted(config.brokers))
    remedy = f"name one of: {known}" if known else "inventory/brokers.yaml has none; add one there"
    if connection.broker:
        message = f"no broker runs on {quoted(connection.broker)}; {remedy}"
    else:
        ends = f"'{connection.target}' or '{connection.source}'"
        message = f"is not given, and no broker runs on {ends}; {remedy}"
    return fault("broker", message, code="no-broker")
