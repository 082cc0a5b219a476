"""Admission checks whether what is demanded can run with the configuration.

The check reads appdefs, registry, inventory and access domains, but not the ledger. It does not
check what the policy allows (:mod:`.permission`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain

from demandops.base.errors import Fault, fault, sentences, suggestion
from demandops.base.naming import id_problem, topic_problem
from demandops.base.quoting import quoted
from demandops.connections import connection as routes
from demandops.connections import connection_types
from demandops.connections.connection import UNSUPPORTED, Connection, ConnectionType
from demandops.model.config.appdef import ApplicationDefinition, Services, named_outputs
from demandops.model.config.config import (
    CHARTS_FILE,
    DOMAINS_FILE,
    IMAGES_FILE,
    NODES_FILE,
    VERSIONS_FILE,
    Config,
)
from demandops.model.demand.demand import LONGEST_S, Application, Delivery, Demand
from demandops.model.ledger.claim import OVERRIDE_PREFIX


def faults(request: Demand, config: Config) -> Iterator[Fault]:
    """Yield a fault for everything in ``request`` that cannot run, whatever the ledger contains."""
    # if the goal gives no request id, the request has the demand's id, which is checked below
    if request.id and request.id != request.demand:
        yield from _id_faults("id" if request.is_reference else "request", request.id)
    if not request.is_reference:
        yield from _id_faults("demand", request.demand)
        if request.demand.startswith(OVERRIDE_PREFIX):
            message = (
                f"starts with '{OVERRIDE_PREFIX}', which only overrides may use; choose another "
                "demand id"
            )
            yield fault("demand", message)
        if not request.demanded:  # otherwise the requesters of each item are checked
            yield from _requester_faults(request.own_requesters)
        lease_s = request.lease_s
        if lease_s is not None and not 0 < lease_s <= LONGEST_S:
            yield fault("lease", f"must be between 1 second and {LONGEST_S} seconds (a year)")
    for index, node in enumerate(request.positions):
        yield from _id_faults(f"positions[{index}].node", node)
        yield from _node_faults(f"positions[{index}].node", node, config)
    # what the initial deployment carries needs no claim, and the notes say so
    if not request.demanded and not request.notes and request.operation not in ("release", "renew"):
        message = "the request lists no application and no connection; list at least one"
        yield fault("id" if request.is_reference else "applications", message, code="empty")
    for item in request.demanded:
        held = item.held
        # the placement itself reports that it found no node, so an empty node is no fault then
        unplaced = isinstance(held, Application) and held.place and not held.node
        of_held = (
            _application_faults(held, config, request.adds_claims)
            if isinstance(held, Application)
            else _connection_faults(held, config, request.adds_claims)
        )
        for each in chain(_id_faults("id", held.id), _requester_faults(item.requesters), of_held):
            if not (unplaced and each.field == "node"):
                yield item.fault(each.field, each.message, code=each.code)


def _application_faults(  # noqa: PLR0912 - a branch for each fault
    app: Application, config: Config, claiming: bool
) -> Iterator[Fault]:
    inputs = [
        (f"inputs.{role}[{position}]", topic)
        for role, topics in app.inputs.items()
        for position, topic in enumerate(topics)
        if not topic.application  # its faults are those of the application whose output it is
    ]
    if app.connect.broker:
        yield from _id_faults("connect.broker", app.connect.broker)
        if app.connect.type not in ("auto", "none"):
            kind = connection_types.type_named(app.connect.type)
            if not kind.takes_broker:
                yield _broker_fault("connect.broker", kind)
    # a shutdown may leave out nodes and sources, because it lists what is booked already
    if claiming or app.node:
        yield from _id_faults("node", app.node)
    for where, topic in inputs:
        if problem := topic_problem(topic.topic):
            yield fault(f"{where}.topic", problem)
        if claiming or topic.source:
            yield from _id_faults(f"{where}.source", topic.source)
        if topic.type:
            yield from _id_faults(f"{where}.type", topic.type)
    appdef = config.appdefs.get(app.appdef)
    if appdef is None:
        yield _unknown_application(app.appdef, config)
    else:
        yield from _definition_faults(app, appdef, config)
    # what is given up may name nodes that the inventory no longer has, or it could not be released
    if not claiming:
        return
    yield from _node_faults("node", app.node, config)
    sources = [(f"{where}.source", topic.source) for where, topic in inputs]
    services = sorted({**app.services, **app.moved}.items())
    for where, node in (*((f"services.{name}", node) for name, node in services), *sources):
        yield from _node_faults(where, node, config)
    for index, delivery in enumerate(app.deliver):
        where = f"deliver[{index}]"
        yield from _id_faults(f"{where}.node", delivery.node)
        yield from _node_faults(f"{where}.node", delivery.node, config)
        if appdef is not None:
            yield from _delivery_faults(where, delivery, config.services[appdef.name])
    if appdef is not None and not any(app.inputs.values()):
        roles = " or ".join(sorted(appdef.inputs))
        yield fault("inputs", f"is empty; list at least one topic of {roles}")


def _delivery_faults(where: str, delivery: Delivery, services: Services) -> Iterator[Fault]:
    outputs, name = named_outputs(services), delivery.output.partition(".")[0]
    if delivery.output not in outputs:
        close = suggestion(delivery.output, outputs)
        yield fault(f"{where}.output", f"{quoted(delivery.output)} is not an output{close}")
    elif delivery.topic and services[name].roots:
        message = (
            f"{name} may make several topics, so a delivery cannot rename them; leave 'topic' out"
        )
        yield fault(f"{where}.topic", message)
    if delivery.topic and (problem := topic_problem(delivery.topic)):
        yield fault(f"{where}.topic", problem)


def _definition_faults(  # noqa: PLR0912 - a branch for each fault
    app: Application, appdef: ApplicationDefinition, config: Config
) -> Iterator[Fault]:
    unknown = [role for role, topics in app.inputs.items() if topics and role not in appdef.inputs]
    for role in unknown:
        message = f"{appdef.name} has no such input" + suggestion(role, appdef.inputs)
        yield fault(f"inputs.{role}", message)
    services = config.services[appdef.name]
    defined = {f"appdefs/{appdef.name}/appdef.yaml": appdef.parameters}
    defined |= {each.file: each.parameters for each in services.values() if each.parameters}
    for name, value in app.parameters.items():
        known = {file: own[name] for file, own in defined.items() if name in own}
        if not known:
            close = suggestion(name, {*chain(*defined.values())})
            yield fault(f"parameters.{name}", f"{appdef.name} has no such parameter{close}")
        for file, parameter in known.items():
            if problem := parameter.problem(value):
                yield fault(f"parameters.{name}", f"{problem} (in {file})")
    for service in services.values():
        if service.nodes and app.node in config.nodes and app.node not in service.runs_at:
            cluster = config.nodes[app.node].cluster
            message = (
                f"'{app.node}' is in cluster '{cluster}', where the application's service "
                f"{service.name} has no node; choose a node in cluster "
                f"{' or '.join(service.nodes)}, or ask for an entry for cluster '{cluster}' in the "
                f"field nodes of {service.file}"
            )
            yield fault("node", message, code="no-node")
    for name in app.named:
        if name not in services:
            close = suggestion(name, [each.name for each in services.values() if each.is_placeable])
            yield fault(f"services.{name}", f"{appdef.name} has no such service{close}")
        elif not services[name].is_placeable:
            message = (
                f"{name} runs at its sources, or serves applications of several types, so a "
                f"demand cannot name the node of {name}; leave {name} out of 'services'"
            )
            yield fault(f"services.{name}", message)
        elif not app.services.get(name):
            yield from _id_faults(f"services.{name}", "")
    versions = sorted(config.application_versions[appdef.name].keys() - {""})
    # An id that ends in '@<version>' belongs to a separate instance, which the generator names. A
    # claim that a person wrote, or an id that only looks like this, would share its names.
    id, _, version = app.id.rpartition("@")
    if app.separate and (not id or version != app.version):
        message = f"{quoted(app.id)} is a separate instance, but does not end in '@{app.version}'"
        yield fault("id", f"{message}; remove the claim, and demand the version instead")
    elif not app.separate and appdef.versions == "separate" and id and version in versions:
        yield fault(
            "id",
            f"{quoted(app.id)} is the instance of version {version}; demand {quoted(id)} with "
            f"version '{version}' instead, or choose an id that does not end in '@{version}'",
        )
    if app.version and app.version not in versions:
        listed = config.entry_files[VERSIONS_FILE].get(appdef.name)
        where = f"{appdef.name} in {listed or config.place_of(CHARTS_FILE)}"
        message = f"{quoted(app.version)} is not a version or channel of {where}"
        if not listed:
            message += f", and {VERSIONS_FILE} lists none of this type"
        yield fault("version", message + suggestion(app.version, versions))


def _unknown_application(name: str, config: Config) -> Fault:
    if name.startswith("#"):  # the number of a DeploymentRequest
        types = [
            f"{appdef.deployment_request.type} ({appdef.name})"
            for appdef in config.appdefs.values()
            if appdef.deployment_request
        ]
        none = "; no appdef.yaml has a deploymentRequest.type: add one, commit and push it"
        shown, remedy = name.removeprefix("#"), f"; known: {', '.join(types)}" if types else none
    else:
        none = (
            "; appdefs/ on main has no application definition: add one (demandops new "
            "application), commit and push it"
        )
        shown, remedy = quoted(name), suggestion(name, config.appdefs) or none
    message = f"{shown} is not a known application type{remedy}"
    return fault("type", message, code="unknown-application")


def _connection_faults(connection: Connection, config: Config, claiming: bool) -> Iterator[Fault]:
    ends = {"source": connection.source, "target": connection.target}
    for end, node in ends.items():
        if claiming or node:
            yield from _id_faults(end, node)
    if connection.broker:
        yield from _id_faults("broker", connection.broker)
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
        yield from _node_faults(end, node, config)
    if connection.type is not None:
        yield from _type_faults(connection.type, connection, config)
    elif (
        all(node in config.nodes for node in connection.nodes)
        and choose_type(connection, config) is None
    ):
        yield _no_type_fault(connection, config)


def _node_faults(where: str, node: str, config: Config) -> Iterator[Fault]:
    # an empty node is reported as an empty id
    if node and node not in config.nodes:
        yield fault(where, f"{quoted(node)} {config.why_no_node(node)}", code="unknown-node")
    elif node and node not in config.domain_of:
        why = config.unlisted.why_not(node) or config.unlisted.of_several_domains(node)
        problem = why or (
            "is not in any access domain; a platform engineer adds it to "
            f"{config.place_of(DOMAINS_FILE)}"
        )
        yield fault(where, f"{quoted(node)} {problem}", code="no-access-domain")


def _id_faults(where: str, value: str) -> Iterator[Fault]:
    if problem := id_problem(value):
        yield fault(where, problem)


def _requester_faults(requesters: tuple[str, ...]) -> Iterator[Fault]:
    for index, requester in enumerate(requesters):
        yield from _id_faults(f"requesters[{index}]", requester)
    if not requesters:
        yield fault("requesters", "is empty; list at least one requester")


# ---- types of connections: whether one can carry a connection, and the first that can ----


def _named(kinds: Iterable[ConnectionType]) -> str:  # `MQTT or ROS`
    return " or ".join(kind.name for kind in kinds)


# Every type supports these options
_ALWAYS = ("type", "reverse")


def choose_type(connection: Connection, config: Config) -> ConnectionType | None:
    fitting = (
        kind
        for kind in connection_types.CONNECTION_TYPES
        if not any(_type_faults(kind, connection, config))
    )
    return next(fitting, None)


def _no_type_fault(connection: Connection, config: Config) -> Fault:
    reasons = []
    for kind in connection_types.CONNECTION_TYPES:
        reason = next(_type_faults(kind, connection, config))
        field = "" if reason.field in ("type", "broker") else f"{reason.field} "
        text = f"{field}{reason.message}"
        reasons.append(text if text.startswith(kind.name) else f"{kind.name}: {text}")
    message = f"no connection type is given, and none fits. {sentences(reasons)}"
    return fault("type", message, code=UNSUPPORTED)


def _type_faults(kind: ConnectionType, connection: Connection, config: Config) -> Iterator[Fault]:
    kinds = connection_types.CONNECTION_TYPES
    ends = {"source": connection.source, "target": connection.target}
    # unknown ones are reported elsewhere
    are_known = all(node in config.nodes for node in ends.values())
    if kind.image not in config.images:
        message = f"{kind.name} needs an image '{kind.image}'; add it to "
        message += config.place_of(IMAGES_FILE)
        yield fault("type", message, code=UNSUPPORTED)
    if connection.broker and not kind.takes_broker:
        yield _broker_fault("broker", kind)
    if kind.speaks_dds and are_known:
        for end, node in ends.items():
            if config.nodes[node].ros.rmw == "rmw_zenoh_cpp":
                able = _named(other for other in kinds if not other.speaks_dds)
                message = (
                    f"'{node}' runs rmw_zenoh_cpp, but type {kind.name} needs DDS; use type "
                    f"{able}, or another rmw in {config.file_of(NODES_FILE, node)}"
                )
                yield fault(end, message, code=UNSUPPORTED)
    yield from kind.link_faults(connection, config) if are_known else ()
    yield from route_faults(kind, connection, config)


def _broker_fault(field: str, kind: ConnectionType) -> Fault:
    able = _named(kind for kind in connection_types.CONNECTION_TYPES if kind.takes_broker)
    message = f"a broker is for {able} only, but the type is {kind.name}; leave the broker out"
    return fault(field, message)


def route_faults(kind: ConnectionType, connection: Connection, config: Config) -> Iterator[Fault]:
    kinds = connection_types.CONNECTION_TYPES
    for index, route in enumerate(connection.topics):
        if topic_problem(route.source) or topic_problem(route.target):
            continue  # the checks of the request report this topic
        where = f"topics[{index}]"
        for name in route.options():
            if name not in _ALWAYS and name not in kind.options:
                able = _named(other for other in kinds if name in other.options)
                yield fault(
                    f"{where}.{name}",
                    f"{name} of '{route.source}' is not supported by {kind.name}; leave it out, or "
                    f"use type {able}",
                )
        yield from kind.route_faults(where, route, connection.key_of(route).sender, config)
        if route.source != route.target and not kind.renames:
            able = _named(other for other in kinds if other.renames)
            yield fault(
                f"{where}.target",
                f"'{route.source}' cannot become '{route.target}', because {kind.name} keeps the "
                f"name of a topic; use the same name at both ends, or use type {able}",
            )
