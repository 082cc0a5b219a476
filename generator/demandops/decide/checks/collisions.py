"""Refuses a demand if something that must be unique would be there twice."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from typing import TypeAlias

from rpds import HashTrieMap, HashTrieSet

from demandops.base.errors import Fault, InvalidInput, Refused, fault
from demandops.connections.connection import ClientKey
from demandops.decide import carriers
from demandops.decide.booking import request_for
from demandops.decide.planning.flows import outputs
from demandops.decide.planning.planner import (
    ReleaseKey,
    claims_needing,
    is_needed,
    keys_of_claims,
    service_name,
)
from demandops.model.config.appdef import Service
from demandops.model.config.config import NODES_FILE, Config
from demandops.model.demand.demand import Application, Demand
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.model.ledger.claim import Claim, ClaimKey, path_of
from demandops.model.ledger.ledger import Changes, World
from demandops.model.release import ServiceKey

# ---- topic clashes: a demand is refused if a node would have two sources of one topic ----
#
# A subscriber would mix the two, without an error. Topics are named as the reference names them, so
# two ids of nodes or applications may give the same topic, for example ``a/b`` and ``a-b``. A
# connection may also bring a topic to a node where a service publishes the same topic.


def topic_faults(
    request: Demand, before: World, after: World, keys: Iterable[ReleaseKey], names: Names
) -> Iterator[Fault]:
    """Yield a fault for each new service, route or delivery that clashes with another source.

    ``names`` are those of ``after``.
    """
    if not request.adds_claims:
        return
    for key in keys:
        if isinstance(key, ServiceKey) and not is_needed(before, key):
            yield from islice(_clashes_of_service(request, after, key, names), 1)
    apps = request.applications
    chosen = any(app.place or {*app.services} - {*app.named} for app in apps)
    for item in request.demanded:
        connection = item.held
        if isinstance(connection, Application):
            continue
        for index, both in carriers.chosen_twice(connection, apps, after.ledger) if chosen else ():
            if not before.ledger.keys_with("route", *connection.key_of(connection.topics[index])):
                message = f"{both}; choose another node"
                yield item.fault(f"topics[{index}]", message, code="conflict")
        for index, route in enumerate(connection.topics):
            _, _, node, topic = connection.key_of(route)
            if connection.id in before.ledger.ids_with("brings", node, topic):
                continue
            # Only services that run before and after the demand count. If an application moves, a
            # connection may bring the application's output back to the old node.
            others = publishers(names, after, node, topic)
            for other in islice((each for each in others if is_needed(before, each)), 1):
                yield item.fault(
                    f"topics[{index}].{'source' if route.reverse else 'target'}",
                    f"connection '{connection.id}' brings {topic} to '{node}', where "
                    f"{words(other)} already publishes this topic; use a connection that brings "
                    "the topic under another name",
                    code="conflict",
                )


def faults_of_claim(claim: Claim, before: World, after: World, names: Names) -> Iterator[Fault]:
    keys = keys_of_claims(after, [claim])
    for clash in topic_faults(request_for(claim), before, after, keys, names):
        yield clash.within(path_of(claim.key))
    for index, route in () if claim.is_on_application else enumerate(claim.connection.topics):
        holders = after.ledger.keys_with("route", *claim.connection.key_of(route))
        if others := {key.subject.id for key in holders} - {claim.subject.id}:
            message = (
                f"connection '{min(others)}' carries this topic between the same nodes already; "
                "remove it from one of the two"
            )
            yield fault(f"topics[{index}]", message, code="conflict").within(path_of(claim.key))


def _clashes_of_service(
    request: Demand, after: World, key: ServiceKey, names: Names
) -> Iterator[Fault]:
    claim = next(iter(claims_needing(after, key)), None)
    if claim is None:
        return
    first = after.ledger.application(claim.subject.id) or claim.application
    service = after.config.services[first.appdef][key.service]
    for name, topic in topics_made(after, service, key).items():
        clashes: list[tuple[str, ServiceKey | None]] = [
            (f"{words(other)} already publishes this topic on", other)
            for other in publishers(names, after, key.node, topic)
            if other != key
        ]
        clashes += [
            (f"connection '{id}' already brings this topic to", None)
            for id in after.ledger.ids_with("brings", key.node, topic)
        ]
        for clash, other in clashes:
            remedy = _remedy(key, other, service, name, after.config)
            message = (
                f"output {name} of {key.service} is {topic}, but {clash} '{key.node}'; {remedy}"
            )
            yield fault(_field(request, key, service), message, code="conflict")


def topics_made(world: World, service: Service, key: ServiceKey) -> dict[str, str]:
    booked = None
    if service.root is not None:
        booked = world.ledger.booked_input(service.root, str(key.source), str(key.topic))
    return outputs(world.config, service, key, further=bool(booked and booked.further))


def publishers(names: Names, world: World, node: str, topic: str) -> Iterator[ServiceKey]:
    """Yield the keys of the needed service instances on a node that publish a topic."""
    for key in sorted(names.get((_TOPIC, f"{node} {topic}")) or (), key=words):
        if isinstance(key, ServiceKey) and is_needed(world, key):
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


def _field(request: Demand, key: ServiceKey, service: Service) -> str:
    for item in request.demanded:
        if not isinstance(item.held, Application):
            continue
        if item.held.id == key.application:
            return item.fault("id", "").field
        for index, topic in enumerate(item.held.inputs.get(str(service.root), ())):
            if (topic.source, topic.topic) == (key.source, key.topic):
                return item.fault(f"inputs.{service.root}[{index}].topic", "").field
    return ""


# ---- name clashes: a demand is refused if a name or file that it needs belongs to another ----
#
# Names and paths contain a short hash of ids (:mod:`.naming`), so ids can be crafted that have the
# same name. A release's name is its file, its objects in a namespace, its ROS node and its client
# at a broker. So no other release in the state repo may have it, on whatever node.

# What is named, in words, and its name. A topic that a service publishes on its node is a name too.
Name: TypeAlias = "tuple[str, str]"
_TOPIC = "topic"

# For each name, the keys of the releases that have it: one, if nobody wrote claims by hand. The
# releases of suspended claims count too, because they will run again. A key that no claim needs any
# longer may be left; :func:`.planner.is_needed` tells. All names of a large
# ledger take long to find, so they follow each change, in a map that shares what did not change.
Names: TypeAlias = "HashTrieMap[Name, HashTrieSet[ReleaseKey]]"

_REMEDY = "use another id, or wait until the other is released"


def names_of(world: World, key: ReleaseKey) -> Iterator[Name]:
    if isinstance(key, ClientKey):
        yield from key.type.names(key)
        return
    app = world.ledger.application(key.application) if key.application is not None else None
    definitions = world.config.services
    for services in [definitions.get(app.appdef, {})] if app else definitions.values():
        service = services.get(key.service)
        # Nothing is named if the configuration no longer has the service.
        if service is not None and service.scope == key.scope:
            yield "release", service_name(world.config, service, key)
            for topic in topics_made(world, service, key).values():
                yield _TOPIC, f"{key.node} {topic}"
            return


def all_names(world: World) -> Names:
    keys = (key for claims in world.ledger.claims.values() for key in keys_of_claims(world, claims))
    return with_keys(HashTrieMap(), world, dict.fromkeys(keys))


def with_keys(names: Names, world: World, keys: Iterable[ReleaseKey]) -> Names:
    for key in keys:
        for name in names_of(world, key):
            names = names.insert(name, (names.get(name) or HashTrieSet()).insert(key))
    return names


def followed(names: Names, before: World, after: World, keys: Collection[ReleaseKey]) -> Names:
    """Return the names in ``after``; only the releases at ``keys`` differ from ``before``."""
    for key in keys:
        for name in names_of(before, key):
            others = (names.get(name) or HashTrieSet()).discard(key)
            names = names.insert(name, others) if others else names.discard(name)
    # A release that an override denies needs its name all the same.
    return with_keys(names, after, (key for key in keys if is_needed(after, key)))


def name_faults(
    request: Demand,
    before: World,
    after: World,
    keys: Iterable[ReleaseKey],
    changes: Changes,
    names: Names,
) -> Iterator[Fault]:
    """Yield a fault for each new release that needs one of ``names``, those of ``before``."""
    for key in keys:
        for name in names_of(after, key):
            others = (names.get(name) or HashTrieSet()).discard(key)
            names = names.insert(name, others.insert(key))  # for the keys that follow
            # A release keeps the name that it has, even if a person gave another one this name.
            # topic_faults tells of topics.
            is_new = is_needed(after, key) and not is_needed(before, key) if others else False
            if name[0] == _TOPIC or not is_new:
                continue
            for other in islice((each for each in others if is_needed(after, each)), 1):
                claims = {change.key.subject: change.key for change in changes.claims}
                needing = (
                    claim
                    for subject, claim in claims.items()
                    if key in keys_of_claims(after, after.ledger.claims_on(subject))
                )
                yield _located(_message(key, name, other), request, next(needing, None))


def faults_in_files(
    request: Demand, changes: Changes, text_at: Callable[[str], str | None]
) -> Iterator[Fault]:
    owners: dict[str, ClaimKey] = {}
    for change in changes.claims:
        path = claim_files.path_of(change.key)
        owner = owners.setdefault(path, change.key)
        if change.before is None and owner == change.key and (text := text_at(path)):
            with suppress(InvalidInput):  # a file that is not valid is no claim, and is replaced
                owner = claim_files.read(text, path).key
        if owner != change.key:
            other = f"{owner.subject} of demand '{owner.demand}'"
            message = f"{change.key.subject} needs the file {path}, which belongs to {other}"
            yield _located(f"{message}; {_REMEDY}", request, change.key)
    for demand in changes.waiting:
        path = records.waiting_path(demand)
        waiting_there = records.read_waiting(text_at(path) or "", path)
        if waiting_there is not None and waiting_there.demand != demand:
            message = f"needs the file {path}, which belongs to demand '{waiting_there.demand}'"
            yield fault("demand", f"{message}; {_REMEDY}", code="conflict")


def refuse_shared_names(world: World, keys: Iterable[ReleaseKey]) -> None:
    taken: dict[Name, ReleaseKey] = {}
    clashes = [
        (key, name, taken[name])
        for key in keys
        for name in names_of(world, key)
        if name[0] != _TOPIC and taken.setdefault(name, key) != key
    ]
    if clashes:
        raise Refused(fault("", _message(*clash), code="conflict") for clash in clashes)


def _message(key: ReleaseKey, name: Name, other: ReleaseKey) -> str:
    needed = f"the {' '.join(name)}, which belongs to {words(other)}"
    return f"{words(key)} needs {needed}; {_REMEDY}"


def _located(message: str, request: Demand, claim: ClaimKey | None) -> Fault:
    for item in request.demanded:
        if claim and item.held.subject == claim.subject:
            return item.fault("id", message, code="conflict")
    clash = fault("", message, code="conflict")
    return clash.within(claim_files.path_of(claim)) if claim else clash
