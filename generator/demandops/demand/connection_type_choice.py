"""The choice of a connection type: which types can carry a connection in this configuration.

:func:`type_faults` yields why a type cannot carry a connection. :func:`with_chosen_types` chooses
the type of each connection that leaves it open.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from demandops.config.config import IMAGES_FILE, NODES_FILE, Config
from demandops.connections import connection_types
from demandops.connections.connection import Connection
from demandops.connections.connection_type import UNSUPPORTED, ConnectionType
from demandops.connections.connection_types import labels
from demandops.connections.route import Route
from demandops.demand.demand_request import AnyRequest, Demanded
from demandops.errors import Fault, fault
from demandops.identifiers import topic_problem

_ALWAYS = ("type", "reverse")

CurrentConnection = Callable[[str], Connection | None]
"""Returns a connection that is already claimed, or ``None``."""


def with_chosen_types(
    request: AnyRequest, config: Config, current: CurrentConnection
) -> AnyRequest:
    """Return ``request`` with a type for each connection that has none.

    A claimed connection keeps its current type. A new one gets the first type that can carry it
    (:func:`type_faults`); if no type can, it still has none.
    """

    def chosen(one: Demanded) -> Demanded:
        if not isinstance(one.held, Connection) or one.held.type is not None:
            return one
        claimed = current(one.held.id)
        found = claimed.type if claimed else choose_type(one.held, config)
        return replace(one, held=replace(one.held, type=found))

    return replace(request, demanded=tuple(map(chosen, request.demanded)))


def choose_type(connection: Connection, config: Config) -> ConnectionType | None:
    """Return the first type that can carry a connection, or ``None`` if no type can."""
    for kind in connection_types.CONNECTION_TYPES:
        if next(type_faults(kind, connection, config), None) is None:
            return kind
    return None


def no_type_fault(connection: Connection, config: Config) -> Fault:
    """Return a fault that says for each type why it cannot carry a connection."""
    reasons = []
    for kind in connection_types.CONNECTION_TYPES:
        reason = next(type_faults(kind, connection, config))
        field = "" if reason.field == "type" else f"{reason.field} "
        reasons.append(f"{kind.name}: {field}{reason.message}")
    message = f"is not given, and no type can carry it. {'; '.join(reasons)}"
    return fault("type", message, code=UNSUPPORTED)


def type_faults(kind: ConnectionType, connection: Connection, config: Config) -> Iterator[Fault]:
    """Yield why ``kind`` cannot carry a connection, by fields of :class:`Connection`.

    Nodes that are not in the inventory are skipped; :mod:`demandops.demand.admission` reports them.
    """
    types = connection_types.CONNECTION_TYPES
    ends = {"source": connection.source, "target": connection.target}
    if kind.image not in config.images:
        message = f"{kind.label} needs an image '{kind.image}'; add it to {IMAGES_FILE}"
        yield fault("type", message, code=UNSUPPORTED)
    if connection.broker and not kind.takes_broker:
        able = " or ".join(known.name for known in types if known.takes_broker)
        yield fault("broker", f"is for {able} only, and the type is {kind.name}; leave it out")
    if kind.speaks_dds and {*ends.values()} <= config.nodes.keys():
        for end, node in ends.items():
            if config.nodes[node].ros.rmw == "rmw_zenoh_cpp":
                able = labels(known for known in types if not known.speaks_dds)
                yield fault(
                    end,
                    f"'{node}' runs rmw_zenoh_cpp, and {kind.name} clients speak DDS; use type "
                    f"{able}, or another rmw in {NODES_FILE}",
                    code=UNSUPPORTED,
                )
    yield from kind.link_faults(connection, config)
    yield from route_faults(kind, connection.topics, (connection.source, connection.target), config)


def route_faults(
    kind: ConnectionType, topics: Iterable[Route], ends: tuple[str, str], config: Config
) -> Iterator[Fault]:
    """Yield a fault for everything in a connection's routes that ``kind`` does not support."""
    types = connection_types.CONNECTION_TYPES
    for index, route in enumerate(topics):
        if topic_problem(route.source) or topic_problem(route.target):
            continue  # the request's own checks report it
        where = f"topics[{index}]"
        for name in route.options():
            if name not in _ALWAYS and name not in kind.options:
                able = labels(known for known in types if name in known.options)
                yield fault(
                    f"{where}.{name}",
                    f"{name} of '{route.source}' is not supported by {kind.name}; leave it out, or "
                    f"use type {able}",
                )
        yield from kind.route_faults(where, route, route.sender_and_receiver(*ends)[0], config)
        if route.source != route.target and not kind.renames:
            able = labels(known for known in types if known.renames)
            yield fault(
                f"{where}.target",
                f"'{route.source}' cannot become '{route.target}': {kind.name} keeps the name; "
                f"use one name, or type {able}",
            )
