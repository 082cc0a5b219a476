"""Topic clashes: a demand is refused if a node would have two sources of one topic.

Topics are named as the reference names them, so two ids of nodes or applications may give the same
topic, for example ``a/b`` and ``a-b``. A connection may also bring a topic to a node where a
service publishes the same topic.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from itertools import islice

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

    A service, route or delivery clashes if it would be a topic's second source on a node. Of a
    service's outputs, only the first that clashes is reported.

    Args:
        request: the demand. If it adds no claims, there are no faults.
        before, after: the world before and after the demand.
        keys: the keys of the releases that the demand may change.
    """
    if not request.adds_claims:
        return
    for key in keys:
        if isinstance(key, ServiceKey) and not is_needed(before, key):
            for service in _service(after, key):
                yield from _of_service(request, after, key, service)
    for one in request.demanded:
        if isinstance(one.held, Connection):
            yield from _of_connection(one, one.held, before, after)
        else:
            yield from _of_flows(one, one.held, after)


def faults_of_claim(claim: Claim, before: World, after: World) -> Iterator[Fault]:
    """Yield the topic clashes that a claim would cause, each located in the claim's file."""
    keys = keys_of_claims(after, [claim])
    for found in faults(request_for(claim), before, after, keys):
        yield found.within(path_of(claim.key))


def _of_service(
    request: DemandRequest, after: World, key: ServiceKey, service: Service
) -> Iterator[Fault]:
    clashes = (
        (name, topic, *clash)
        for name, topic in _topics(after, service, key).items()
        for clash in _clashes(after, key, service, name, topic)
    )
    for name, topic, clash, remedy in islice(clashes, 1):
        yield fault(
            _field(request, key, service),
            f"output {name} of {key.service} is {topic}, but {clash} '{key.node}'; {remedy}",
            code="conflict",
        )


def _clashes(
    world: World, key: ServiceKey, service: Service, output: str, topic: str
) -> Iterator[tuple[str, str]]:
    """Yield (clash, remedy) for each other source of ``topic`` on the node of ``key``.

    The instance at ``key`` publishes ``topic`` as ``output``. Clash and remedy are parts of a
    message. A clash is, for example, ``connection 'a' already brings this topic to``.
    """
    for other in _publishers(world, key.node, topic, excluded=key):
        clash = f"{words(other)} already publishes this topic on"
        yield clash, _remedy(key, other, service, output, world.config)
    for id in world.ledger.connections_bringing(key.node, topic):
        clash = f"connection '{id}' already brings this topic to"
        yield clash, _remedy(key, None, service, output, world.config)


def _of_connection(
    one: Demanded, connection: Connection, before: World, after: World
) -> Iterator[Fault]:
    """Yield a fault for each new route that brings a topic to a node where a service publishes it.

    A service that the demand starts or stops causes no fault here. So if an application moves, a
    connection may bring the application's output back to the old node.
    """
    for index, route in enumerate(connection.topics):
        _, node = route.sender_and_receiver(*connection.nodes)
        topic = route.written_topic
        if connection.id in before.ledger.connections_bringing(node, topic):
            continue
        others = (one for one in _publishers(before, node, topic) if is_needed(after, one))
        for other in islice(others, 1):
            yield one.fault(
                f"topics[{index}].{'source' if route.reverse else 'target'}",
                f"connection '{connection.id}' brings {topic} to '{node}', where "
                f"{words(other)} already publishes this topic; use a connection that brings the "
                "topic under another name",
                code="conflict",
            )


def _of_flows(one: Demanded, app: Application, after: World) -> Iterator[Fault]:
    """Yield a fault for each output that the receiving node already gets from another source.

    A topic that the demand lists as an input is never a fault, because the demand names the source.
    """
    apart = app.deliver or app.services or app.moved
    for flow in flows(after.config, app) if apart else ():
        ids = after.ledger.connections_bringing(flow.receiver, flow.target)
        for id in ids if flow.delivery is not None or flow.is_output else ():
            other = after.ledger.connection(id)
            elsewhere = other is not None and {*other.nodes} != {flow.sender, flow.receiver}
            if flow.delivery is None:
                if elsewhere:
                    message = (
                        f"{flow.target} already comes to '{flow.receiver}' by connection '{id}', "
                        f"and would also come from '{flow.sender}'; choose another node for the "
                        "service that reads this topic"
                    )
                    yield one.fault("id", message, code="conflict")
                continue
            if elsewhere:
                yield one.fault(
                    f"deliver[{flow.delivery}].output",
                    f"{flow.target} already comes to '{flow.receiver}' by connection '{id}'; leave "
                    "this delivery out",
                    code="conflict",
                )
                continue
            routes = (
                route for c in after.ledger.connection_claims(id) for route in c.connection.topics
            )
            read = {one.read_topic for one in routes if one.written_topic == flow.target}
            for topic in sorted(read - {flow.topic})[:1]:
                yield one.fault(
                    f"deliver[{flow.delivery}].topic",
                    f"connection '{id}' already brings {topic} to '{flow.receiver}' as "
                    f"{flow.target}; choose another topic for this delivery",
                    code="conflict",
                )


def _service(world: World, key: ServiceKey) -> Iterator[Service]:
    """Yield the service at ``key``; yield nothing if no claim needs the instance at ``key``."""
    for claim in claims_needing(world, key)[:1]:
        first = world.ledger.application(claim.subject.id) or claim.application
        yield world.config.services[first.appdef][key.service]


def _topics(world: World, service: Service, key: ServiceKey) -> dict[str, str]:
    input = (str(service.root), str(key.source), str(key.topic))
    booked = world.ledger.booked_input(*input) if service.root else None
    return outputs(world.config, service, key, further=bool(booked and booked.further))


def _publishers(
    world: World, node: str, topic: str, *, excluded: ServiceKey | None = None
) -> Iterator[ServiceKey]:
    """Yield the keys of the service instances on a node that publish ``topic``.

    The output patterns of the appdefs tell which instances would publish the topic. The instance
    ``excluded`` and each instance that no claim needs are left out.
    """
    for services in world.config.services.values():
        for name, service in services.items():
            for pattern in service.outputs.values():
                first, *others = map(re.escape, pattern.split("{instance}"))
                expression = first + "(.+)" + r"\1".join(others) if others else first
                match = re.fullmatch(expression, topic)
                if match is None:
                    continue
                found = (
                    _keys_called(world, node, name, service, match[1], excluded)
                    if others
                    else _keys_on(world, node, service)
                )
                yield from (key for key in found if key != excluded and is_needed(world, key))


def _keys_called(
    world: World,
    node: str,
    name: str,
    service: Service,
    instance: str,
    excluded: ServiceKey | None,
) -> Iterator[ServiceKey]:
    """Yield the keys of a service's instances on ``node`` that topic names show as ``instance``.

    Some of the instances may not run. The instance ``excluded`` may be left out.
    """
    ledger, config, role = world.ledger, world.config, service.root
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
    """Yield the keys of the instances of a service on a node; some of them may not run."""
    name = service.name
    if service.scope == "cluster":
        yield ServiceKey(name, node, for_cluster=True)
        return
    for id in world.ledger.applications_at(node):
        for key in keys_of(world, Subject(SubjectKind.APPLICATION, id)):
            if isinstance(key, ServiceKey) and (key.node, key.service) == (node, name):
                yield key


def words(key: ReleaseKey) -> str:
    """Return what a release is, in words for a message."""
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
    """Return how to resolve a clash; ``other`` is ``None`` if the clash is with a connection."""
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
    """Return which field of the request makes a service run; empty if no field does."""
    for one in request.demanded:
        if not isinstance(one.held, Application):
            continue
        if one.held.id == key.application:
            return one.place("id")
        for index, topic in enumerate(one.held.inputs.get(str(service.root), ())):
            if (topic.source, topic.topic) == (key.source, key.topic):
                return one.place(f"inputs.{service.root}[{index}].topic")
    return ""
