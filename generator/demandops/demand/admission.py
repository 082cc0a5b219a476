"""Admission checks whether what is demanded can run with the configuration.

The check reads appdefs, registry, inventory and access domains, but not the ledger. It does not
check what the policy allows (:mod:`demandops.demand.permission`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from itertools import chain

from demandops.config.appdef import ApplicationDefinition, Services
from demandops.config.config import DOMAINS_FILE, NODES_FILE, Config
from demandops.config.repo_settings import ROOT_FILE, Limits
from demandops.connections import connection_types
from demandops.connections import route as routes
from demandops.connections.connection import Connection
from demandops.demand.application import Application, Delivery
from demandops.demand.claim import OVERRIDE_PREFIX
from demandops.demand.demand_request import AnyRequest, Demanded, DemandRequest, Put, Release, Renew
from demandops.demand.lease import LONGEST_S
from demandops.errors import Fault, fault, suggestion
from demandops.identifiers import id_problem, topic_problem
from demandops.quoting import quoted


def faults(request: DemandRequest, config: Config) -> Iterator[Fault]:
    """Yield a fault for everything in ``request`` that cannot run, whatever the ledger contains.

    A shutdown may name nodes that are no longer in the inventory, so that claims on these nodes can
    be released.
    """
    # if the goal gives no request id, the request has the demand's id, which is checked below
    if request.id and request.id != request.demand:
        yield from _id("id" if request.is_reference else "request", request.id)
    if not request.is_reference:
        yield from _own_fields(request)
    for index, node in enumerate(request.positions if isinstance(request, Put) else ()):
        yield from _id(f"positions[{index}].node", node)
        yield from _node(f"positions[{index}].node", node, config)
    if not request.demanded and not isinstance(request, Release | Renew):
        yield fault(
            "id" if request.is_reference else "applications",
            "the request lists no application and no connection; list at least one",
            code="empty",
        )
    for one in request.demanded:
        found = chain(_id("id", one.held.id), _requesters(one.requesters))
        if isinstance(one.held, Application):
            found = chain(found, _application(one.held, config, request.adds_claims))
        else:
            found = chain(found, _connection(one.held, config, request.adds_claims))
        for each in found:
            # the placement itself reports that it found no node, so an empty node is no fault then
            held = one.held
            if (
                each.field == "node"
                and isinstance(held, Application)
                and held.place
                and not held.node
            ):
                continue
            yield replace(each, field=one.place(each.field))


# Fields of goals whose lists have no items of their own (items_of)
_NOT_COUNTED = ("parameters", "parameters_json", "target_topics")
_FIELDS_OF_ITEM = 10
_ITEMS = (
    "items (applications, connections, topics, requesters and so on, also of the connections that "
    "it needs)"
)


def length_faults(goal: object, limits: Limits) -> Iterator[Fault]:
    """Yield a fault if a goal, as plain data, is far too large to be parsed at all.

    The check ends where the goal is too large, whatever it contains.
    """
    length = items = fields = 0
    most_fields = max(1_000, _FIELDS_OF_ITEM * limits.demand_items)
    left: list[tuple[object, bool]] = [(goal, True)]
    while (
        left
        and length <= limits.demand_characters
        and items <= limits.demand_items
        and fields <= most_fields
    ):
        value, counts = left.pop()
        if isinstance(value, str):
            length += len(value)
        elif isinstance(value, list):
            length += 2 * len(value)  # each part is at least a character and a comma
            items += len(value) if counts else 0
            left += [(part, counts) for part in value]
        elif isinstance(value, dict):
            fields += len(value)
            length += sum(1 + len(key) if isinstance(key, str) else 1 for key in value)
            left += [(part, counts and key not in _NOT_COUNTED) for key, part in value.items()]
        elif isinstance(value, int):
            length += value.bit_length() // 4
    if length > limits.demand_characters:
        size = f"has more than {limits.demand_characters} characters"
        message = _too_large(size, "demandCharacters", limits.demand_characters)
        yield fault("", message, code="too-large")
    if fields > most_fields:
        message = _too_large(f"has more than {most_fields} fields", "demandItems", most_fields)
        yield fault("", message, code="too-large")
    if items > limits.demand_items:
        size = f"lists more than {limits.demand_items} {_ITEMS}"
        message = _too_large(size, "demandItems", limits.demand_items)
        yield fault("", message, code="too-large")


def items_of(request: DemandRequest) -> int:
    """Return how many things a request lists in total.

    Each requester of an application or a connection holds each of its topics, so a topic counts
    once for each of them.
    """
    items = len(request.own_requesters)
    items += len(request.positions) if isinstance(request, Put) else 0
    for one in request.demanded:
        held = one.held
        if isinstance(held, Application):
            topics = sum(map(len, held.inputs.values()))
            items += len(held.deliver) + len(held.named) + (held.place.size if held.place else 0)
        else:
            topics = len(held.topics)
        items += len(one.requesters) if request.is_reference else 0
        items += (1 + topics) * max(1, len(one.requesters))
    return items


def size_faults(request: DemandRequest, limits: Limits) -> Iterator[Fault]:
    """Yield a fault for each limit on items and parameters that the request exceeds."""
    for one in request.demanded:
        held = one.held
        if isinstance(held, Application) and held.parameters:
            size = len(json.dumps(dict(held.parameters), default=str))
            if size > limits.parameter_bytes:
                message = _too_large(f"have {size} bytes", "parameterBytes", limits.parameter_bytes)
                yield one.fault("parameters", message, code="too-large")
    items = items_of(request)
    if items > limits.demand_items:
        listed = f"lists {items} {_ITEMS}"
        message = _too_large(listed, "demandItems", limits.demand_items)
        yield fault("id" if request.is_reference else "demand", message, code="too-large")


def _too_large(size: str, limit: str, most: int) -> str:
    return (
        f"{size}, but at most {most} are allowed; a platform engineer may raise limits.{limit} in "
        f"{ROOT_FILE}"
    )


def _own_fields(request: DemandRequest) -> Iterator[Fault]:
    """Yield the faults of a Demand's id and lease, and of its requesters if it lists no items."""
    yield from _id("demand", request.demand)
    if request.demand.startswith(OVERRIDE_PREFIX):
        message = (
            f"starts with '{OVERRIDE_PREFIX}', which only overrides may use; choose another "
            "demand id"
        )
        yield fault("demand", message)
    if not request.demanded:  # otherwise the requesters of each item are checked
        yield from _requesters(request.own_requesters)
    lease_s = request.lease_s if isinstance(request, Put) else None
    if lease_s is not None and not 0 < lease_s <= LONGEST_S:
        yield fault("lease", f"must be between 1 second and {LONGEST_S} seconds (a year)")


def _application(app: Application, config: Config, claiming: bool) -> Iterator[Fault]:
    inputs = [
        (f"inputs.{role}[{position}]", topic)
        for role, topics in app.inputs.items()
        for position, topic in enumerate(topics)
    ]
    if claiming or app.node:
        yield from _id("node", app.node)
    for where, topic in inputs:
        problem = topic_problem(topic.topic)
        if problem:
            yield fault(f"{where}.topic", problem)
        if claiming or topic.source:
            yield from _id(f"{where}.source", topic.source)
        if topic.type:
            yield from _id(f"{where}.type", topic.type)
    appdef = config.appdefs.get(app.appdef)
    if appdef is None:
        yield _unknown_application(app.appdef, config)
    else:
        yield from _of_appdef(app, appdef, config)
    if not claiming:
        return
    yield from _node("node", app.node, config)
    sources = [(f"{where}.source", topic.source) for where, topic in inputs]
    services = sorted({**app.services, **app.moved}.items())
    for where, node in (*((f"services.{name}", node) for name, node in services), *sources):
        yield from _node(where, node, config)
    for index, delivery in enumerate(app.deliver):
        where = f"deliver[{index}]"
        yield from _id(f"{where}.node", delivery.node)
        yield from _node(f"{where}.node", delivery.node, config)
        if appdef is not None:
            yield from _delivery(where, delivery, config.services[appdef.name])
    if appdef is not None and not any(app.inputs.values()):
        roles = " or ".join(sorted(appdef.inputs))
        yield fault("inputs", f"is empty; list at least one topic of {roles}")


def _delivery(where: str, delivery: Delivery, services: Services) -> Iterator[Fault]:
    name, _, output = delivery.output.partition(".")
    service = services.get(name)
    if service is None or output not in service.outputs:
        known = [f"{one.name}.{output}" for one in services.values() for output in one.outputs]
        message = f"{quoted(delivery.output)} is not an output{suggestion(delivery.output, known)}"
        yield fault(f"{where}.output", message)
    elif delivery.topic and service.roots:
        message = (
            f"{name} may make several topics, so a delivery cannot rename them; leave 'topic' out"
        )
        yield fault(f"{where}.topic", message)
    problem = topic_problem(delivery.topic) if delivery.topic else ""
    if problem:
        yield fault(f"{where}.topic", problem)


def _of_appdef(app: Application, appdef: ApplicationDefinition, config: Config) -> Iterator[Fault]:
    for role, topics in app.inputs.items():
        if role not in appdef.inputs and topics:
            message = f"{appdef.name} has no such input" + suggestion(role, appdef.inputs)
            yield fault(f"inputs.{role}", message)
    parameters = config.parameters_of(appdef.name) if app.parameters else set()
    for name in app.parameters:
        if name not in parameters:
            known = suggestion(name, parameters)
            yield fault(f"parameters.{name}", f"{appdef.name} has no such parameter{known}")
    for service in config.services[appdef.name].values():
        if service.nodes and app.node in config.nodes and app.node not in service.runs_at:
            cluster = config.nodes[app.node].cluster
            yield fault(
                "node",
                f"'{app.node}' is in cluster '{cluster}', where the application's service "
                f"{service.name} has no node; choose a node in cluster "
                f"{' or '.join(service.nodes)}, or ask for an entry for cluster '{cluster}' in the "
                f"field nodes of {service.file}",
                code="no-node",
            )
    yield from _named_services(app, appdef.name, config)
    versions = config.versions_of(appdef.name)
    yield from _instance(app, appdef, versions)
    if app.version and app.version not in versions:
        yield fault(
            "version",
            f"{quoted(app.version)} is not a version or channel of {appdef.name} in "
            f"{config.versions_file(appdef.name)}{suggestion(app.version, versions)}",
        )


def _named_services(app: Application, appdef: str, config: Config) -> Iterator[Fault]:
    services = config.services[appdef]
    for name in app.named:
        service = services.get(name)
        if service is None:
            known = suggestion(name, [one.name for one in services.values() if one.is_placeable])
            yield fault(f"services.{name}", f"{appdef} has no such service{known}")
        elif not service.is_placeable:
            message = (
                f"{name} runs at its sources, or serves applications of several types, so a "
                f"demand cannot name the node of {name}; leave {name} out of 'services'"
            )
            yield fault(f"services.{name}", message)
        elif not app.services.get(name):
            yield from _id(f"services.{name}", "")


def _instance(
    app: Application, appdef: ApplicationDefinition, versions: Collection[str]
) -> Iterator[Fault]:
    id, _, named = app.id.rpartition("@")
    if app.separate and (not id or named != app.version):
        message = f"{quoted(app.id)} is a separate instance, but does not end in '@{app.version}'"
        yield fault("id", f"{message}; remove the claim, and demand the version instead")
    elif not app.separate and appdef.versions == "separate" and id and named in versions:
        yield fault(
            "id",
            f"{quoted(app.id)} is the instance of version {named}; demand {quoted(id)} with "
            f"version '{named}' instead, or choose an id that does not end in '@{named}'",
        )


def _unknown_application(name: str, config: Config) -> Fault:
    if name.startswith("#"):  # the number of a DeploymentRequest
        types = [
            f"{appdef.deployment_request.type} ({appdef.name})"
            for appdef in config.appdefs.values()
            if appdef.deployment_request
        ]
        none = "; no appdef.yaml has a deploymentRequest.type: add one, commit and push it"
        known = f"; known: {', '.join(types)}" if types else none
    else:
        none = (
            "; appdefs/ on main has no application definition: add one (demandops new "
            "application), commit and push it"
        )
        known = suggestion(name, config.appdefs) or none
    shown = name.removeprefix("#") if name.startswith("#") else quoted(name)
    message = f"{shown} is not a known application type{known}"
    return fault("appdef", message, code="unknown-application")


def _connection(connection: Connection, config: Config, claiming: bool) -> Iterator[Fault]:
    ends = {"source": connection.source, "target": connection.target}
    for end, node in ends.items():
        if claiming or node:
            yield from _id(end, node)
    if connection.broker:
        yield from _id("broker", connection.broker)
    if claiming and not connection.topics:
        yield fault("topics", "is empty; list at least one topic")
    yield from routes.faults("topics", connection.topics)
    same_place = connection.source and connection.source == connection.target
    for index, route in enumerate(connection.topics):
        if claiming and same_place and route.source == route.target:
            yield fault(
                f"topics[{index}].target",
                f"{quoted(route.target)} would feed itself, because source and target are both "
                f"{quoted(connection.source)}; name another target node or topic",
            )
    if not claiming:
        return
    for end, node in ends.items():
        yield from _node(end, node, config)
    if connection.type is not None:
        yield from connection_types.type_faults(connection.type, connection, config)
    elif {*connection.nodes} <= config.nodes.keys() and connection_types.choose_type(
        connection, config
    ) is None:
        yield connection_types.no_type_fault(connection, config)


def _node(where: str, node: str, config: Config) -> Iterator[Fault]:
    if not node:
        return  # reported as an empty id
    if node not in config.nodes:
        yield fault(
            where,
            f"{quoted(node)} is not in {config.place_of(NODES_FILE)}"
            + suggestion(node, config.nodes),
            code="unknown-node",
        )
    elif node not in config.domain_of:
        yield fault(
            where,
            f"{quoted(node)} is not in any access domain; a platform engineer adds it to "
            f"{config.place_of(DOMAINS_FILE)}",
            code="no-access-domain",
        )


def _id(where: str, value: str) -> Iterator[Fault]:
    problem = id_problem(value)
    if problem:
        yield fault(where, problem)


def _requesters(requesters: tuple[str, ...]) -> Iterator[Fault]:
    for index, requester in enumerate(requesters):
        yield from _id(f"requesters[{index}]", requester)
    if not requesters:
        yield fault("requesters", "is empty; list at least one requester")


def with_chosen_types(
    request: AnyRequest, config: Config, current: Callable[[str], Connection | None]
) -> AnyRequest:
    """Return ``request`` with the type that each connection gets.

    A type that the request names stays. If the request names none, a claimed connection keeps the
    type of its claim, and a new connection gets the first type that can carry it
    (:func:`connection_types.choose_type`). If no type can carry a connection, its type
    stays ``None``. If the type carries a connection in another way than the request says, such as
    over another broker than it names, the connection is changed and a note says so. A request that
    adds no claims stays as it is.

    Args:
        request: the request.
        config: the configuration, which has the nodes and brokers.
        current: takes an id and returns the claimed connection that has it, or ``None``.
    """

    def chosen(one: Demanded) -> Demanded:
        connection = one.held
        if not isinstance(connection, Connection) or not request.adds_claims:
            return one
        if connection.type is None:
            claimed = current(connection.id)
            found = claimed.type if claimed else connection_types.choose_type(connection, config)
            connection = replace(connection, type=found)
        if connection.type is None or id_problem(connection.broker or "none"):
            return replace(one, held=connection)
        held, note = connection.type.settled(connection, config)
        return replace(one, held=held, note=note or one.note)

    return replace(request, demanded=tuple(map(chosen, request.demanded)))
