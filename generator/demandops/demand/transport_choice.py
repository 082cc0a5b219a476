"""Which type of connection can carry what is asked, by this configuration.

:func:`obstacles` says what keeps one type from it; :func:`resolved` chooses where the type is
left open. Both are pure functions of request and configuration; what is booked comes in as
an argument.
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
from demandops.demand.demand_request import ConnectionDemand, ConnectionType, DemandRequest
from demandops.demand.route import Route
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
"""The options of a route that a type's client can honour; message type and direction all can."""

_IMAGES = {
    ConnectionType.MQTT: MQTT_CLIENT_IMAGE,
    ConnectionType.ZENOH: ZENOH_BRIDGE_IMAGE,
    ConnectionType.ROS: DDS_ROUTER_IMAGE,
}
_ALWAYS = ("type", "reverse")
_UNCARRIED = "unsupported-connection-type"

Standing = Callable[[str], ConnectionType | None]
"""Returns the type of a connection that something holds already, or nothing."""


def with_chosen_types(request: DemandRequest, config: Config, standing: Standing) -> DemandRequest:
    """Return ``request`` with every ``AUTO`` made the type that carries the connection.

    A connection that stands keeps its type. Otherwise the first of Zenoh, MQTT and ROS that
    nothing keeps from carrying it (:func:`obstacles`); ``AUTO`` stays where there is none.
    """
    connections = tuple(
        replace(asked, type=(standing(asked.id) or choose_type(asked, config)).value)
        if asked.type == ConnectionType.AUTO.value
        else asked
        for asked in request.connections
    )
    return replace(request, connections=connections)


def choose_type(asked: ConnectionDemand, config: Config) -> ConnectionType:
    """Return the type that a connection without one gets; ``AUTO`` where none can carry it."""
    for kind in PREFERENCE:
        if next(type_faults(kind, asked, config), None) is None:
            return kind
    return ConnectionType.AUTO


def no_type_fault(asked: ConnectionDemand, config: Config) -> Fault:
    """Say of each type what keeps it from carrying a connection."""
    reasons = []
    for kind in PREFERENCE:
        found = next(type_faults(kind, asked, config))
        place = "" if found.field == "type" else f"{found.field} "
        reasons.append(f"{kind.name}: {place}{found.message}")
    message = f"is open, and nothing can carry it. {'; '.join(reasons)}"
    return fault("type", message, code=_UNCARRIED)


def type_faults(kind: ConnectionType, asked: ConnectionDemand, config: Config) -> Iterator[Fault]:
    """Yield what keeps ``kind`` from carrying a connection, by fields of :class:`ConnectionDemand`.

    Nodes that are not in the inventory are told elsewhere and passed over here.
    """
    if kind is not ConnectionType.MQTT and _IMAGES[kind] not in config.images:
        yield fault(
            "type",
            f"{kind.value} ({kind.name}) needs an image '{_IMAGES[kind]}'; add it to {IMAGES_FILE}",
            code=_UNCARRIED,
        )
    yield from _ends(kind, asked, config)
    yield from route_faults(kind, asked.topics, (asked.source, asked.target), config)


def route_faults(
    kind: ConnectionType, topics: Iterable[Route], ends: tuple[str, str], config: Config
) -> Iterator[Fault]:
    """Yield what of the routes between two ends ``kind`` cannot do, by ``topics[i].<option>``."""
    for index, route in enumerate(topics):
        if topic_problem(route.source) or topic_problem(route.target):
            continue  # told by the request's own checks
        where = f"topics[{index}]"
        yield from _options(where, kind, route)
        if kind is ConnectionType.ROS:
            yield from _of_dds(where, route, route.sender_and_receiver(*ends)[0], config)
        if kind is not ConnectionType.MQTT and route.source != route.target:
            yield fault(
                f"{where}.target",
                f"'{route.source}' cannot become '{route.target}': {kind.name} keeps the name; "
                "use one name, or type 1 (MQTT)",
            )


def _ends(kind: ConnectionType, asked: ConnectionDemand, config: Config) -> Iterator[Fault]:
    source, target = config.nodes.get(asked.source), config.nodes.get(asked.target)
    if kind is ConnectionType.MQTT:
        # where the broker is open it follows from the ends, which may be told already
        known = asked.broker or (source and target)
        if known and choose_broker(asked.broker, asked.source, asked.target, config) is None:
            yield _no_broker(asked, config)
        return
    if asked.broker:
        yield fault("broker", f"is of MQTT only, and this is {kind.name}; leave it out")
    if source is None or target is None:
        return
    for end, node in (("source", source), ("target", target)):
        if node.ros.rmw == "rmw_zenoh_cpp":
            yield fault(
                end,
                f"'{node.id}' runs rmw_zenoh_cpp, and {kind.name} clients speak DDS; use type 1 "
                f"(MQTT), or another rmw in {NODES_FILE}",
                code=_UNCARRIED,
            )
    if kind is ConnectionType.ROS:
        if source.wan is None and target.wan is None:
            yield fault(
                "type",
                f"0 (ROS) needs an address that one end can be reached at; add wan: {{host: …}} to "
                f"'{source.id}' or '{target.id}' in {NODES_FILE}",
                code=_UNCARRIED,
            )
        return
    yield from _zenoh_ends(source, target)


def _zenoh_ends(source: Node, target: Node) -> Iterator[Fault]:
    for end, node in (("source", source), ("target", target)):
        if node.zenoh is None:
            yield fault(
                end,
                f"'{node.id}' runs no Zenoh bridge; add zenoh: {{endpoint: …}} to it in "
                f"{NODES_FILE}, or zenoh: {{}} where others can be reached from it",
                code=_UNCARRIED,
            )
    if source.zenoh is None or target.zenoh is None:
        return
    reachable = source.zenoh.endpoint or target.zenoh.endpoint
    if source.id != target.id and not (
        reachable or set(source.zenoh.connect) & set(target.zenoh.connect)
    ):
        yield fault(
            "type",
            f"2 (ZENOH) finds no way between '{source.id}' and '{target.id}'; give one of them an "
            f"endpoint under zenoh in {NODES_FILE}, or both one router under connect",
            code=_UNCARRIED,
        )


def _options(where: str, kind: ConnectionType, route: Route) -> Iterator[Fault]:
    for name in route.options():
        if name in _ALWAYS or name in SUPPORTED_OPTIONS[kind]:
            continue
        able = [other for other in PREFERENCE if name in SUPPORTED_OPTIONS[other]]
        names = " or ".join(f"{other.value} ({other.name})" for other in able)
        yield fault(
            f"{where}.{name}",
            f"{name} of '{route.source}' is nothing that {kind.name} can do; leave it out, or use "
            f"type {names}",
        )


def _of_dds(where: str, route: Route, node: str, config: Config) -> Iterator[Fault]:
    if node in config.nodes and not message_type(route, node, config):
        yield fault(
            f"{where}.type",
            f"the message type of '{route.source}' is not known, and ROS needs it; say it in the "
            f"request where it has a field for it, or add it to types of '{node}' in {NODES_FILE}",
        )
    if route.durability and not route.reliability:
        yield fault(
            f"{where}.reliability",
            f"is open while durability of '{route.source}' is set; ROS needs both, add it",
        )


def message_type(route: Route, node: str, config: Config) -> str:
    """Return the message type of a route that is read on ``node``, as said or by the inventory."""
    known = config.nodes.get(node)
    return route.type or (known.types.get(route.read_topic, "") if known else "")


def choose_broker(requested: str, source: str, target: str, config: Config) -> Broker | None:
    """Return the broker of a connection: the requested one, the target's, the source's, the only.

    Nothing where none of these exists. ``requested`` is a node id or empty.
    """
    if requested:
        return config.brokers.get(requested)
    for node in (target, source):
        if node in config.brokers:
            return config.brokers[node]
    if len(config.brokers) == 1:
        return next(iter(config.brokers.values()))
    return None


def _no_broker(asked: ConnectionDemand, config: Config) -> Fault:
    known = ", ".join(sorted(config.brokers))
    remedy = f"name one of: {known}" if known else "inventory/brokers.yaml has none; add one there"
    if asked.broker:
        message = f"no broker runs on {quoted(asked.broker)}; {remedy}"
    else:
        message = f"is open, and no broker runs on '{asked.target}' or '{asked.source}'; {remedy}"
    return fault("broker", message, code="no-broker")
