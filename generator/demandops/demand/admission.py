"""Admission: the check that the configuration can run what a request demands.

It uses appdefs, inventory, brokers and access domains, but not the ledger.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.connections import connection_types
from demandops.demand import connection_type_choice
from demandops.demand import demand_request as shape
from demandops.demand.demand_request import (
    AUTO,
    ApplicationDemand,
    ConnectionDemand,
    DemandRequest,
)
from demandops.errors import Fault, fault, quoted, suggestion


def faults(request: DemandRequest, config: Config) -> Iterator[Fault]:
    """Yield every reason why ``request`` cannot be fulfilled, whatever the ledger contains.

    A shutdown may name nodes that are not in the inventory, so that their claims can be released.
    """
    yield from shape.faults(request)
    claiming = request.operation.adds_claims
    for index, app in enumerate(request.applications):
        yield from _application(f"applications[{index}]", app, config, claiming)
    for index, connection in enumerate(request.connections):
        yield from _connection(f"connections[{index}]", connection, config, claiming)


def _application(
    where: str, app: ApplicationDemand, config: Config, claiming: bool
) -> Iterator[Fault]:
    appdef = config.appdefs.get(app.appdef)
    if appdef is None:
        yield _unknown_application(where, app.appdef, config)
    else:
        for role, topics in app.inputs.items():
            if role not in appdef.inputs and topics:
                yield fault(
                    f"{where}.inputs.{role}",
                    f"{appdef.name} has no such input" + suggestion(role, appdef.inputs),
                )
        for name in app.parameters:
            if name not in appdef.parameters:
                yield fault(
                    f"{where}.parameters.{name}",
                    f"{appdef.name} has no such parameter" + suggestion(name, appdef.parameters),
                )
        if app.version and app.version not in config.versions_of(appdef.name):
            yield fault(
                f"{where}.version",
                f"{quoted(app.version)} is not a version or channel of {appdef.name} in "
                "registry/charts.yaml" + suggestion(app.version, config.versions_of(appdef.name)),
            )
    if not claiming:
        return
    yield from _node(f"{where}.node", app.node, config)
    for role, topics in app.inputs.items():
        for position, topic in enumerate(topics):
            yield from _node(f"{where}.inputs.{role}[{position}].source", topic.source, config)
    if appdef is not None and not any(app.inputs.values()):
        yield fault(
            f"{where}.inputs",
            f"is empty; list at least one topic of {' or '.join(sorted(appdef.inputs))}",
        )


def _unknown_application(where: str, name: str, config: Config) -> Fault:
    if name.startswith("#"):  # the number of a DeploymentRequest
        known = "; known: " + ", ".join(
            f"{appdef.deployment_request.type} ({appdef.name})"
            for appdef in config.appdefs.values()
            if appdef.deployment_request
        )
    else:
        known = suggestion(name, config.appdefs)
    shown = name.removeprefix("#") if name.startswith("#") else quoted(name)
    message = f"{shown} is not a known application type{known}"
    return fault(f"{where}.appdef", message, code="unknown-application")


def _connection(
    where: str, connection: ConnectionDemand, config: Config, claiming: bool
) -> Iterator[Fault]:
    kind = connection.chosen_type
    if kind is None and connection.type != AUTO:
        known = ", ".join(known.label for known in connection_types.by_number())
        yield fault(
            f"{where}.type",
            f"{connection.type} is not a connection type; known: {known}",
            code="unknown-connection-type",
        )
    if not claiming:
        return
    yield from _node(f"{where}.source", connection.source, config)
    yield from _node(f"{where}.target", connection.target, config)
    if kind is not None:
        for found in connection_type_choice.type_faults(kind, connection, config):
            yield _within(where, found)
    elif (
        connection.type == AUTO
        and {connection.source, connection.target} <= config.nodes.keys()
        and connection_type_choice.choose_type(connection, config) is None
    ):
        yield _within(where, connection_type_choice.no_type_fault(connection, config))


def _within(where: str, found: Fault) -> Fault:
    """Return a fault of one part of the request, with its field below ``where``."""
    return replace(found, field=f"{where}.{found.field}")


def _node(where: str, node: str, config: Config) -> Iterator[Fault]:
    if not node:
        return  # the request's own checks report it
    if node not in config.nodes:
        yield fault(
            where,
            f"{quoted(node)} is not in inventory/nodes.yaml" + suggestion(node, config.nodes),
            code="unknown-node",
        )
    elif node not in config.domain_of:
        yield fault(
            where,
            f"{quoted(node)} is not in any access domain; a platform engineer adds it to "
            "policy/access-domains.yaml",
            code="no-access-domain",
        )
