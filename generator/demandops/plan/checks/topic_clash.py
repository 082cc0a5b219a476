"""Topic clashes: two services on one node would publish the same topic, so a demand is refused.

Topics are named as the reference names them, so two ids may give one name: ``a/b`` and ``a-b``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from itertools import islice

from demandops import naming
from demandops.config.appdef import Service
from demandops.config.config import NODES_FILE
from demandops.demand.application import Application
from demandops.demand.demand_request import DemandRequest
from demandops.errors import Fault, fault
from demandops.ledger.world import World
from demandops.plan.output_topics import outputs, usual_topic
from demandops.plan.release import ServiceKey
from demandops.plan.release_keys import ReleaseKey, claims_needing, is_needed, keys_of
from demandops.subject import Subject, SubjectKind


def faults(
    request: DemandRequest, before: World, after: World, keys: Iterable[ReleaseKey]
) -> Iterator[Fault]:
    """Yield a fault for each new service with a topic that another on its node publishes.

    Args:
        request: the demand.
        before, after: the world before and after it.
        keys: the releases that it may change.
    """
    for key in keys:
        if not isinstance(key, ServiceKey) or is_needed(before, key):
            continue
        for service in _service(after, key):
            clashes = (
                (name, topic, other)
                for name, topic in _topics(after, service, key).items()
                for other in _others(after, key, topic)
            )
            for name, topic, other in islice(clashes, 1):
                yield fault(
                    _field(request, key, service),
                    f"its {name} is {topic}, which {_words(other)} publishes on '{key.node}' "
                    f"already; {_remedy(key, other, service)}",
                    code="conflict",
                )


def _service(world: World, key: ServiceKey) -> Iterator[Service]:
    """Yield the service of a key, if it must run."""
    for claim in claims_needing(world, key)[:1]:
        yield world.config.services[claim.application.appdef][key.service]


def _topics(world: World, service: Service, key: ServiceKey) -> dict[str, str]:
    input = (str(service.root), str(key.source), str(key.topic))
    booked = world.ledger.booked_input(*input) if service.root else None
    return outputs(world.config, service, key, further=bool(booked and booked.further))


def _others(world: World, key: ServiceKey, topic: str) -> Iterator[ServiceKey]:
    """Yield the other services on the node of ``key`` that publish ``topic``.

    An appdef's pattern says which instance of its service would, and the ledger whether it runs.
    """
    for services in world.config.services.values():
        for name, service in services.items():
            for pattern in service.outputs.values():
                first, *others = map(re.escape, pattern.split("{instance}"))
                expression = first + "(.+)" + r"\1".join(others) if others else first
                match = re.fullmatch(expression, topic)
                if match is None:
                    continue
                found = _named(world, key, name, service, match[1]) if others else _all(world, key)
                for other in found:
                    if other != key and other.service == name and is_needed(world, other):
                        yield other


def _named(
    world: World, key: ServiceKey, name: str, service: Service, instance: str
) -> Iterator[ServiceKey]:
    """Yield the instances of a service on the node of ``key`` that are called ``instance``."""
    ledger, config, role = world.ledger, world.config, service.root
    if service.scope == "node":
        if naming.topic_part(key.node) == instance:
            yield ServiceKey(name, key.node)
        return
    if role is None:
        for id in ledger.applications_in_topics(instance):
            yield ServiceKey(name, key.node, application=id)
        return
    for source in config.nodes_by_topic_part.get(instance, ()):
        usual = usual_topic(config, source, role)
        own = str(key.topic) if source == key.source else ""
        for topic in (usual,) if usual else ledger.usual_topics(role, source, but=own):
            yield ServiceKey(name, key.node, source=source, topic=topic)


def _all(world: World, key: ServiceKey) -> Iterator[ServiceKey]:
    """Yield the services on the node of ``key``."""
    for id in world.ledger.applications_at(key.node):
        for other in keys_of(world, Subject(SubjectKind.APPLICATION, id)):
            if isinstance(other, ServiceKey) and other.node == key.node:
                yield other


def _words(key: ServiceKey) -> str:
    if key.application is not None:
        return f"application '{key.application}'"
    if key.scope == "node":
        return key.service
    return f"{key.service} for {key.topic} of '{key.source}'"


def _remedy(key: ServiceKey, other: ServiceKey, service: Service) -> str:
    if key.application is not None:
        return "use another application id"
    if "node" in (key.scope, other.scope):
        return f"change this output in {service.file}"
    if key.source == other.source:
        return (
            f"name the usual one of the two as topics.{service.root} of '{key.source}' in "
            f"{NODES_FILE}"
        )
    return f"give '{key.source}' another id in {NODES_FILE}"


def _field(request: DemandRequest, key: ServiceKey, service: Service) -> str:
    """Return the field of the request that needs the service."""
    for one in request.demanded:
        if not isinstance(one.held, Application):
            continue
        if one.held.id == key.application:
            return one.place("id")
        for index, topic in enumerate(one.held.inputs.get(str(service.root), ())):
            if (topic.source, topic.topic) == (key.source, key.topic):
                return one.place(f"inputs.{service.root}[{index}].topic")
    return ""
