"""Admission: the check that the configuration can run what a request demands.

It uses appdefs, inventory, brokers and access domains, but not the ledger.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.connections import connection_types
from demandops.connections.connection import Connection
from demandops.demand import demand_request as shape
from demandops.demand.application import Application
from demandops.demand.demand_request import AnyRequest, Demanded, DemandRequest
from demandops.errors import Fault, fault, quoted, suggestion


def faults(request: DemandRequest, config: Config) -> Iterator[Fault]:
    """Yield every reason why ``request`` cannot be fulfilled, whatever the ledger contains.

    A shutdown may name nodes that are not in the inventory, so that their claims can be released.
    """
    yield from shape.faults(request)
    for one in request.demanded:
        if isinstance(one.held, Application):
            found = _application(one.held, config, request.adds_claims)
        else:
            found = _connection(one.held, config) if request.adds_claims else iter(())
        yield from (replace(each, field=one.place(each.field)) for each in found)


def _application(app: Application, config: Config, claiming: bool) -> Iterator[Fault]:
    appdef = config.appdefs.get(app.appdef)
    if appdef is None:
        yield _unknown_application(app.appdef, config)
    else:
        for role, topics in app.inputs.items():
            if role not in appdef.inputs and topics:
                message = f"{appdef.name} has no such input" + suggestion(role, appdef.inputs)
                yield fault(f"inputs.{role}", message)
        for name in app.parameters:
            if name not in appdef.parameters:
                known = suggestion(name, appdef.parameters)
                yield fault(f"parameters.{name}", f"{appdef.name} has no such parameter{known}")
        if app.version and app.version not in config.versions_of(appdef.name):
            yield fault(
                "version",
                f"{quoted(app.version)} is not a version or channel of {appdef.name} in "
                "registry/charts.yaml" + suggestion(app.version, config.versions_of(appdef.name)),
            )
    if not claiming:
        return
    yield from _node("node", app.node, config)
    for role, topics in app.inputs.items():
        for position, topic in enumerate(topics):
            yield from _node(f"inputs.{role}[{position}].source", topic.source, config)
    if appdef is not None and not any(app.inputs.values()):
        roles = " or ".join(sorted(appdef.inputs))
        yield fault("inputs", f"is empty; list at least one topic of {roles}")


def _unknown_application(name: str, config: Config) -> Fault:
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
    return fault("appdef", message, code="unknown-application")


def _connection(connection: Connection, config: Config) -> Iterator[Fault]:
    yield from _node("source", connection.source, config)
    yield from _node("target", connection.target, config)
    if connection.type is not None:
        yield from connection_types.type_faults(connection.type, connection, config)
    elif {*connection.nodes} <= config.nodes.keys() and connection_types.choose_type(
        connection, config
    ) is None:
        yield connection_types.no_type_fault(connection, config)


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


def with_chosen_types(
    request: AnyRequest, config: Config, current: Callable[[str], Connection | None]
) -> AnyRequest:
    """Return ``request`` with a type for each connection that has none.

    A claimed connection keeps its current type. A new one gets the first type that can carry it
    (:func:`connection_types.type_faults`); if no type can, it still has none.
    """

    def chosen(one: Demanded) -> Demanded:
        if not isinstance(one.held, Connection) or one.held.type is not None:
            return one
        claimed = current(one.held.id)
        found = claimed.type if claimed else connection_types.choose_type(one.held, config)
        return replace(one, held=replace(one.held, type=found))

    return replace(request, demanded=tuple(map(chosen, request.demanded)))
