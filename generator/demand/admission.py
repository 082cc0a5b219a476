"""Admission: can what is asked be run at all, by this catalog?

Checks a request against appdefs, inventory, brokers and access domains. What is booked already
does not matter here; that is the ledger's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from generator.catalog.catalog import Catalog
from generator.catalog.inventory import Broker
from generator.demand import request as shape
from generator.demand.request import (
    AUTO,
    ApplicationDemand,
    ConnectionDemand,
    ConnectionType,
    DemandRequest,
)
from generator.errors import Fault, fault, near, shown

SUPPORTED_CONNECTIONS = frozenset({ConnectionType.MQTT})
"""The connection types that :mod:`generator.render.connections` can write."""


def faults(request: DemandRequest, catalog: Catalog) -> Iterator[Fault]:
    """Yield every reason why ``request`` cannot be honoured, whatever is booked.

    A shutdown is not held to the inventory: what a removed node still holds can be released.
    """
    yield from shape.faults(request)
    joining = request.operation.asks
    for index, app in enumerate(request.applications):
        yield from _application(f"applications[{index}]", app, catalog, joining)
    for index, connection in enumerate(request.connections):
        yield from _connection(f"connections[{index}]", connection, catalog, joining)


def with_types(request: DemandRequest) -> DemandRequest:
    """Return the request with a type for each connection that leaves it open."""

    def typed(connection: ConnectionDemand) -> ConnectionDemand:
        open_type = connection.type == AUTO
        return replace(connection, type=ConnectionType.MQTT.value) if open_type else connection

    return replace(request, connections=tuple(map(typed, request.connections)))


def choose_broker(requested: str, source: str, target: str, catalog: Catalog) -> Broker | None:
    """Return the broker of a connection: the requested one, the target's, the source's, the only.

    Nothing where none of these exists. ``requested`` is a node id or empty.
    """
    if requested:
        return catalog.brokers.get(requested)
    for node in (target, source):
        if node in catalog.brokers:
            return catalog.brokers[node]
    if len(catalog.brokers) == 1:
        return next(iter(catalog.brokers.values()))
    return None


def _application(
    where: str, app: ApplicationDemand, catalog: Catalog, joining: bool
) -> Iterator[Fault]:
    appdef = catalog.appdefs.get(app.appdef)
    if appdef is None:
        yield _unknown_application(where, app.appdef, catalog)
    else:
        for role, topics in app.inputs.items():
            if role not in appdef.inputs and topics:
                yield fault(
                    f"{where}.inputs.{role}",
                    f"{appdef.name} takes no such input" + near(role, appdef.inputs),
                )
        for name in app.parameters:
            if name not in appdef.parameters:
                yield fault(
                    f"{where}.parameters.{name}",
                    f"{appdef.name} has no such parameter" + near(name, appdef.parameters),
                )
        if app.version and app.version not in catalog.versions_of(appdef.name):
            yield fault(
                f"{where}.version",
                f"{shown(app.version)} is no version or channel of {appdef.name} in "
                "registry/charts.yaml" + near(app.version, catalog.versions_of(appdef.name)),
            )
    if not joining:
        return
    yield from _node(f"{where}.node", app.node, catalog)
    for role, topics in app.inputs.items():
        for position, topic in enumerate(topics):
            yield from _node(f"{where}.inputs.{role}[{position}].source", topic.source, catalog)
    if appdef is not None and not any(app.inputs.values()):
        yield fault(
            f"{where}.inputs",
            f"is empty; list at least one topic of {' or '.join(sorted(appdef.inputs))}",
        )


def _unknown_application(where: str, asked: str, catalog: Catalog) -> Fault:
    if asked.startswith("#"):  # the number of a DeploymentRequest
        known = "; known: " + ", ".join(
            f"{one.deployment_request.type} ({one.name})"
            for one in catalog.appdefs.values()
            if one.deployment_request
        )
    else:
        known = near(asked, catalog.appdefs)
    named = asked.removeprefix("#") if asked.startswith("#") else shown(asked)
    message = f"{named} names no application definition{known}"
    return fault(f"{where}.appdef", message, code="unknown-application")


def _connection(
    where: str, connection: ConnectionDemand, catalog: Catalog, joining: bool
) -> Iterator[Fault]:
    types = {known.value: known for known in ConnectionType}
    kind = types.get(connection.type)
    if kind is None:
        known = ", ".join(f"{number} ({item.name})" for number, item in types.items())
        yield fault(
            f"{where}.type",
            f"{connection.type} is no connection type; known: {known}",
            code="unknown-connection-type",
        )
    if not joining:
        return
    yield from _node(f"{where}.source", connection.source, catalog)
    yield from _node(f"{where}.target", connection.target, catalog)
    if kind is None:
        return
    if kind not in SUPPORTED_CONNECTIONS:
        usable = ", ".join(f"{item.value} ({item.name})" for item in SUPPORTED_CONNECTIONS)
        yield fault(
            f"{where}.type",
            f"{kind.value} ({kind.name}) is not carried by this version; use {usable}",
            code="unsupported-connection-type",
        )
        return
    ends_known = connection.source in catalog.nodes and connection.target in catalog.nodes
    if not (connection.broker or ends_known):
        return  # which broker follows from the ends, and these are told already
    if choose_broker(connection.broker, connection.source, connection.target, catalog) is None:
        yield _no_broker(where, connection, catalog)


def _no_broker(where: str, connection: ConnectionDemand, catalog: Catalog) -> Fault:
    known = ", ".join(sorted(catalog.brokers))
    remedy = f"name one of: {known}" if known else "inventory/brokers.yaml has none; add one there"
    if connection.broker:
        message = f"no broker runs on {shown(connection.broker)}; {remedy}"
    else:
        message = (
            f"is open, and no broker runs on '{connection.target}' or '{connection.source}'; "
            f"{remedy}"
        )
    return fault(f"{where}.broker", message, code="no-broker")


def _node(where: str, node: str, catalog: Catalog) -> Iterator[Fault]:
    if not node:
        return  # told by the request's own checks
    if node not in catalog.nodes:
        yield fault(
            where,
            f"{shown(node)} is not in inventory/nodes.yaml" + near(node, catalog.nodes),
            code="unknown-node",
        )
    elif node not in catalog.domain_of:
        yield fault(
            where,
            f"{shown(node)} is in no access domain; a platform engineer adds it to "
            "policy/access-domains.yaml",
            code="no-access-domain",
        )
