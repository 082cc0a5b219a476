"""Topic clashes: a demand is refused if a node would have two sources of one topic.

A subscriber would mix the two, without an error. Topics are named as the reference names them, so
two ids of nodes or applications may give the same topic, for example ``a/b`` and ``a-b``. A
connection may also bring a topic to a node where a service publishes the same topic.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from itertools import chain, islice

from demandops import naming
from demandops.config.appdef import Service
from demandops.config.config import NODES_FILE, Config
from demandops.connections.connection import Connection
from demandops.connections.connection_type import ClientKey
from demandops.demand.application import Application
from demandops.demand.claim import Claim
from demandops.demand.demand_request import Demanded, DemandRequest
from demandops.errors import Fault, fault
from demandops.ledger.claim_file import path_of
from demandops.ledger.operations.restoration import request_for
from demandops.ledger.world import World
from demandops.plan.flows import flows
from demandops.plan.output_topics import outputs, usual_topic
from demandops.plan.release import ServiceKey
from demandops.plan.release_keys import (
    ReleaseKey,
    claims_needing,
    is_needed,
    keys_of,
    keys_of_claims,
)
from demandops.subject import Subject, SubjectKind


def faults(
    request: DemandRequest, before: World, after: World, keys: Iterable[ReleaseKey]
) -> Iterator[Fault]:
    """Yield a fault for each new service, route or delivery that clashes with another source.

    It clashes if it would be a topic's second source on a node. Of a service's outputs, only the
    first that clashes is reported. ``keys`` are the keys of the releases that the demand may
    change.
    """
    if not request.adds_claims:
        return
    for key in keys:
        if isinstance(key, ServiceKey) and not is_needed(before, key):
            yield from islice(_clashes_of_service(request, after, key), 1)
    for item in request.demanded:
        if isinstance(item.held, Connection):
            yield from _clashes_of_connection(item, item.held, before, after)
        else:
            yield from _clashes_of_flows(item, item.held, after)


def faults_of_claim(claim: Claim, before: World, after: World) -> Iterator[Fault]:
    keys = keys_of_claims(after, [claim])
    for clash in faults(request_for(claim), before, after, keys):
        yield clash.within(path_of(claim.key))


def _clashes_of_service(request: DemandRequest, after: World, key: ServiceKey) -> Iterator[Fault]:
    claim = next(iter(claims_needing(after, key)), None)
    if claim is None:
        return
    first = after.ledger.application(claim.subject.id) or claim.application
    service = after.config.services[first.appdef][key.service]
    further = False
    if service.root is not None:
        booked = after.ledger.booked_input(service.root, str(key.source), str(key.topic))
        further = bool(booked and booked.further)
    for name, topic in outputs(after.config, service, key, further=further).items():
        publishers = (
            (f"{words(other)} already publishes this topic on", other)
            for other in _publishers(after, key.node, topic, excluded=key)
        )
        connections = (
            (f"connection '{id}' already brings this topic to", None)
            for id in after.ledger.connections_bringing(key.node, topic)
        )
        for clash, other in chain[tuple[str, ServiceKey | None]](publishers, connections):
            remedy = _remedy(key, other, service, name, after.config)
            yield fault(
                _field(request, key, service),
                f"output {name} of {key.service} is {topic}, but {clash} '{key.node}'; {remedy}",
                code="conflict",
            )


def _clashes_of_connection(
    item: Demanded, connection: Connection, before: World, after: World
) -> Iterator[Fault]:
    for index, route in enumerate(connection.topics):
        _, node = route.sender_and_receiver(*connection.nodes)
        topic = route.written_topic
        if connection.id in before.ledger.connections_bringing(node, topic):
            continue
        # Only services that run before and after the demand count. If an application moves, a
        # connection may bring the application's output back to the old node.
        staying = (key for key in _publishers(before, node, topic) if is_needed(after, key))
        for other in islice(staying, 1):
            yield item.fault(
                f"topics[{index}].{'source' if route.reverse else 'target'}",
                f"connection '{connection.id}' brings {topic} to '{node}', where "
                f"{words(other)} already publishes this topic; use a connection that brings the "
                "topic under another name",
                code="conflict",
            )


def _clashes_of_flows(item: Demanded, app: Application, after: World) -> Iterator[Fault]:
    """Yield a fault for each output that the receiving node already gets from another source."""
    has_outputs_elsewhere = app.deliver or app.services or app.moved
    for flow in flows(after.config, app) if has_outputs_elsewhere else ():
        # Of an input that the demand lists, the demand names the source, so it is no fault.
        if flow.delivery is None and not flow.is_output:
            continue
        for id in after.ledger.connections_bringing(flow.receiver, flow.target):
            other = after.ledger.connection(id)
            elsewhere = other is not None and {*other.nodes} != {flow.sender, flow.receiver}
            if flow.delivery is None:
                if elsewhere:
                    message = (
                        f"{flow.target} already comes to '{flow.receiver}' by connection '{id}', "
                        f"and would also come from '{flow.sender}'; choose another node for the "
                        "service that reads this topic"
                    )
                    yield item.fault("id", message, code="conflict")
                continue
            if elsewhere:
                yield item.fault(
                    f"deliver[{flow.delivery}].output",
                    f"{flow.target} already comes to '{flow.receiver}' by connection '{id}'; leave "
                    "this delivery out",
                    code="conflict",
                )
                continue
            claims = after.ledger.connection_claims(id)
            routes = (route for claim in claims for route in claim.connection.topics)
            read = {route.read_topic for route in routes if route.written_topic == flow.target}
            for topic in sorted(read - {flow.topic})[:1]:
                yield item.fault(
                    f"deliver[{flow.delivery}].topic",
                    f"connection '{id}' already brings {topic} to '{flow.receiver}' as "
                    f"{flow.target}; choose another topic for this delivery",
                    code="conflict",
                )


def _publishers(
    world: World, node: str, topic: str, *, excluded: ServiceKey | None = None
) -> Iterator[ServiceKey]:
    """Yield the keys of the service instances on a node that publish ``topic``.

    The instance ``excluded`` and each instance that no claim needs are left out.
    """
    # The output patterns of the definitions tell which instances would publish the topic. So only
    # these are looked up, and not the outputs of all services on the node.
    for services in world.config.services.values():
        for service in services.values():
            for pattern in service.outputs.values():
                first, *others = map(re.escape, pattern.split("{instance}"))
                expression = first + "(.+)" + r"\1".join(others) if others else first
                match = re.fullmatch(expression, topic)
                if match is None:
                    continue
                keys = (
                    _keys_called(world, node, service, match[1], excluded)
                    if others
                    else _keys_on(world, node, service)
                )
                yield from (key for key in keys if key != excluded and is_needed(world, key))


def _keys_called(
    world: World, node: str, service: Service, instance: str, excluded: ServiceKey | None
) -> Iterator[ServiceKey]:
    """Yield the keys of a service's instances on ``node`` that topic names show as ``instance``.

    Some of the instances may not run. The instance ``excluded`` may be left out.
    """
    ledger, config = world.ledger, world.config
    name, role = service.name, service.root
    if service.scope in ("node", "cluster"):
        if naming.topic_part(node) == instance:
            yield ServiceKey(name, node, for_cluster=service.scope == "cluster")
        return
    if role is None:
        for id in ledger.applications_in_topics(instance):
            yield ServiceKey(name, node, application=id)
        return
    for source in config.nodes_by_topic_part.get(instance, ()):
        usual = usual_topic(config, source, role)
        is_own = excluded is not None and (excluded.service, excluded.source) == (name, source)
        own = str(excluded.topic) if excluded and is_own else ""
        for topic in (usual,) if usual else ledger.usual_topics(role, source, excluded=own):
            yield ServiceKey(name, node, source=source, topic=topic)
    for further, version in ledger.further_topics(role, instance):
        own = "" if service.shared else version
        yield ServiceKey(name, node, source=further.source, topic=further.topic, version=own)


def _keys_on(world: World, node: str, service: Service) -> Iterator[ServiceKey]:
    """Yield the keys of a service's instances on a node; some of them may not run."""
    name = service.name
    if service.scope == "cluster":
        yield ServiceKey(name, node, for_cluster=True)
        return
    for id in world.ledger.applications_at(node):
        for key in keys_of(world, Subject(SubjectKind.APPLICATION, id)):
            if isinstance(key, ServiceKey) and (key.node, key.service) == (node, name):
                yield key


def words(key: ReleaseKey) -> str:
    if isinstance(key, ClientKey):
        return f"connection '{key.id}'" if key.side else f"the {key.type.name} client of '{key.id}'"
    if key.application is not None:
        return f"application '{key.application}'"
    if key.scope in ("node", "cluster"):
        return key.service
    return f"{key.service} for {key.topic} of '{key.source}'"


def _remedy(
    key: ServiceKey, other: ServiceKey | None, service: Service, output: str, config: Config
) -> str:
    """Return how to resolve a clash; ``other`` is ``None`` if it is with a connection."""
    is_named = "{instance}" in service.outputs[output]
    is_of_same = (
        other is not None
        and other.service != key.service
        and (other.application, other.source) == (key.application, key.source)
    )
    if key.application is not None and is_named and not is_of_same:
        return "use another application id"
    if other is None:
        return "let the connection bring the topic under another name"
    if not is_named or is_of_same or {"node", "cluster"} & {key.scope, other.scope}:
        return f"change this output in {service.file}"
    file = config.file_of(NODES_FILE, str(key.source))
    if key.source == other.source:
        where = f"topics.{service.root} of '{key.source}' in {file}"
        return f"choose one of the two topics as the usual one, and list it in {where}"
    return f"give '{key.source}' another id in {file}"


def _field(request: DemandRequest, key: ServiceKey, service: Service) -> str:
    for item in request.demanded:
        if not isinstance(item.held, Application):
            continue
        if item.held.id == key.application:
            return item.place("id")
        for index, topic in enumerate(item.held.inputs.get(str(service.root), ())):
            if (topic.source, topic.topic) == (key.source, key.topic):
                return item.place(f"inputs.{service.root}[{index}].topic")
    return ""
