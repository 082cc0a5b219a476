"""The releases that claims need: their keys, and :func:`plan`, which returns the release at a key.

A release follows from the ledger and the configuration alone, so every generator and every replay
of a commit plans the same.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from types import MappingProxyType

from demandops.base import naming, strict_yaml
from demandops.base.errors import InvalidInput, Refused, suggestion
from demandops.base.naming import Subject, SubjectKind
from demandops.connections import connection as routes
from demandops.connections.connection import ClientKey, Connection, ConnectionType, Route
from demandops.decide.admission.admission import route_faults
from demandops.decide.planning import overrides
from demandops.decide.planning.flows import (
    instances,
    is_bridged,
    node_of,
    outputs,
    roots_of,
    topics_of_origin,
    usual_topic,
    version_of_instance,
)
from demandops.decide.planning.overrides import without_suspended
from demandops.model.config.appdef import Parameter, Scaling, Service, Services
from demandops.model.config.config import VERSIONS_FILE, Config
from demandops.model.config.override import Override
from demandops.model.config.registry import ApplicationVersion, precedence
from demandops.model.demand.demand import Application, InputTopic
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.ledger.ledger import ClaimChange, Ledger, World
from demandops.model.release import Autoscaler, Release, ServiceKey, ServiceRelease

# ---- the version of an application that is deployed: the newest that its claims ask for ----
#
# A claim on an application asks for a named version, or for the default version. A service that
# several applications share has the newest of the versions of these applications. So the order of
# the claims does not matter, and two demands that renew in turn do not restart the pods again and
# again. :mod:`.forbidden` decides whether a demand may ask for another version than the
# existing demands.


def running_version(world: World, application: str) -> ApplicationVersion | None:
    """Return the deployed version; ``None`` if nobody holds it or its appdef is missing."""
    app = world.ledger.application(application)
    versions = world.config.application_versions.get(app.appdef) if app else None
    return newest_asked(world.ledger, application, versions) if versions else None


def newest_asked(
    ledger: Ledger, application: str, versions: Mapping[str, ApplicationVersion]
) -> ApplicationVersion:
    """Return the newest of ``versions`` that claims on an application ask for, or the default."""
    asked = ledger.versions_asked(application, versions)
    return max((versions[word] for word in asked or ("",)), key=lambda version: version.rank)


def version_of_service(
    world: World, service: Service, applications: Iterable[str]
) -> ApplicationVersion:
    """Return the version in which a service runs for the applications that share it.

    At least one of the applications must have a version (:func:`running_version`).

    Raises:
        Refused: if another appdef has the same chart version, but different images.
    """
    newest: dict[str, ApplicationVersion] = {}
    for running in filter(None, (running_version(world, id) for id in applications)):
        if running.rank > newest.setdefault(running.appdef, running).rank:
            newest[running.appdef] = running
    # Ranks are comparable only within one appdef, and all versions of a service have its chart. So
    # among several appdefs, the one with the newest chart decides.
    versions = [version for _, version in sorted(newest.items())]
    best = max(versions, key=lambda version: precedence(version.charts[service.chart].version))
    for other in versions:
        its, own = contents(other, service), contents(best, service)
        if its[0] == own[0] and its != own:  # neither is the newest
            file = world.config.place_of(VERSIONS_FILE)
            message = (
                f"application definitions '{best.appdef}' and '{other.appdef}' share "
                f"{service.chart} {own[0]}, but pin different images; pin the same images, or "
                f"give one of the definitions another version of the chart, in {file}"
            )
            raise Refused.at("version", message, code="conflict")
    return best


def contents(version: ApplicationVersion, service: Service) -> tuple[object, ...]:
    pins = (version.images.get(name) for name in service.images)
    return version.charts[service.chart].version, *pins


# ---- the keys of the releases that claims need, and of those that a change of claims affects ----
#
# Only the releases that :func:`affected_keys` returns are planned again for a demand, so the cost
# of a demand does not grow with the number of other demands.

ReleaseKey = ServiceKey | ClientKey


def keys_of(world: World, subject: Subject, *, strict: bool = False) -> Iterator[ReleaseKey]:
    # With ``strict``, a missing definition raises Refused, so that no service ends because its
    # definition was deleted; else nothing is yielded for it.
    world = without_suspended(world)
    yield from keys_of_claims(world, world.ledger.claims_on(subject), strict=strict)


def keys_of_claims(
    world: World, claims: Iterable[Claim], *, strict: bool = False
) -> Iterator[ReleaseKey]:
    """Yield the keys of the releases that ``claims`` need in ``world``, each once."""
    keys: dict[ReleaseKey, None] = {}
    for claim in claims:
        if not claim.is_on_application:
            connection = world.ledger.connection(claim.subject.id) or claim.connection
            if connection.type is None:  # no type fits: what is tried here will be refused
                continue
            keys |= dict.fromkeys(connection.type.keys(connection.id, *connection.nodes))
            continue
        # The first claim on an application decides its appdef and nodes for all claims on it.
        first = world.ledger.application(claim.subject.id) or claim.application
        app = claim.application.moved_to_nodes_of(first)
        if strict or first.appdef in world.config.services:
            for service in services_of(world.config, first.appdef).values():
                keys |= dict.fromkeys(instances(app, service))
    yield from keys


def claims_needing(world: World, key: ServiceKey) -> tuple[Claim, ...]:
    """Return the claims that need a service instance, sorted by application and demand.

    For a service that runs once for each cluster, they are grouped by appdef first. Callers pass a
    world without suspended claims if these must not count.
    """
    ledger = world.ledger
    if key.application is not None:
        needed = _service(world, key.application, key) is not None
        return ledger.application_claims(key.application) if needed else ()
    if key.for_cluster:
        users = (name for name, own in world.config.services.items() if key.service in own)
        claims = tuple(claim for name in users for claim in ledger.claims_with("definition", name))
    elif key.scope == "node":
        claims = ledger.claims_with("node", key.node)
    else:
        claims = ledger.claims_with("takes", str(key.source), str(key.topic))
    services = {id: _service(world, id, key) for id in {claim.subject.id for claim in claims}}
    return tuple(
        claim
        for claim in claims
        if (service := services[claim.subject.id]) and takes(claim.application, service, key)
    )


def is_needed(world: World, key: ReleaseKey) -> bool:
    """Return whether a claim needs a release; suspended claims in ``world`` count."""
    if isinstance(key, ClientKey):
        if key.side is None:
            return bool(world.ledger.ids_with("link", key.type.name, key.id))
        connection = world.ledger.connection(key.id)
        return connection is not None and connection.type is key.type
    if key.application is not None:
        return _service(world, key.application, key) is not None
    if key.scope in ("node", "cluster"):
        return bool(claims_needing(world, key))
    # Thousands of claims may read a topic. This ends at the first that needs the instance.
    return any(
        service is not None and takes(claim.application, service, key)
        for claim in world.ledger.each_with("takes", str(key.source), str(key.topic))
        for service in (_service(world, claim.subject.id, key),)
    )


def takes(app: Application, service: Service, key: ServiceKey) -> bool:
    return not service.roots or bool(roots_of(app, service, key))


def _service(world: World, application: str, key: ServiceKey) -> Service | None:
    """Return the service of an application to which the instance may belong, or ``None``."""
    first = world.ledger.application(application)
    services = world.config.services.get(first.appdef, {}) if first else {}
    service = services.get(key.service)
    if first is None or service is None or service.scope != key.scope:
        return None
    if key.scope == "topic" and version_of_instance(first, service) != key.version:
        return None
    return service if node_of(first, service, key.source or key.node) == key.node else None


def affected_keys(
    before: World, after: World, changes: Iterable[ClaimChange]
) -> tuple[ReleaseKey, ...]:
    """Return the key of every release that these changes of claims may add, change or remove.

    The cost grows with the number of changed topics. If a change moves an application or gives it
    another appdef or version, the cost grows with the number of all its topics.
    """
    before, after = without_suspended(before), without_suspended(after)
    keys: dict[ReleaseKey, None] = {}
    for change in changes:
        subject, claims = change.key.subject, (change.before, change.after)
        if change.before and change.after and change.before.is_on_application:
            # reduced to the inputs that differ, if nothing else that matters to a release does
            mine, its = change.before.application, change.after.application
            same_requesters = change.before.requesters == change.after.requesters
            if (
                replace(its, inputs=mine.inputs) == mine
                # a parameter's value may depend on the booking times
                and not mine.parameters
                and (same_requesters or not _may_depend_on_requesters(its, after))
            ):
                claims = (
                    replace(change.before, held=_with_inputs_not_in(mine, its)),
                    replace(change.after, held=_with_inputs_not_in(its, mine)),
                )
        old, new = before.ledger.application(subject.id), after.ledger.application(subject.id)
        is_moved = False
        if subject.kind is SubjectKind.APPLICATION and old and new:
            versions = (running_version(world, subject.id) for world in (before, after))
            ranks = {version and version.rank for version in versions}
            is_moved = not old.has_same_definition_and_nodes(new) or len(ranks) > 1
        for world, claim in zip((before, after), claims, strict=True):
            affected = [claim] if claim and world.ledger.get(claim.key) else []
            if is_moved:
                # The claims of other demands did not change, but what they need runs elsewhere now,
                # or in another version.
                affected += world.ledger.claims_on(subject)
            keys |= dict.fromkeys(keys_of_claims(world, affected, strict=world is after))
    return tuple(keys)


def _may_depend_on_requesters(app: Application, world: World) -> bool:
    # if an override selects by them, or a service's definition derives the replicas from them
    selectors = (selector for override in world.overrides for selector in override.select)
    services = world.config.services.get(app.appdef, {}).values()
    return any(selector.requesters for selector in selectors) or any(
        service.scaling.may_depend_on_requesters for service in services
    )


def _with_inputs_not_in(app: Application, other: Application) -> Application:
    inputs = {}
    for role, topics in app.inputs.items():
        others = {*other.inputs.get(role, ())}
        inputs[role] = tuple(topic for topic in topics if topic not in others)
    return app.with_inputs(inputs)


def all_keys(world: World) -> tuple[ReleaseKey, ...]:
    """Return the key of every release; raise ``Refused`` if a definition is missing."""
    subjects = [Subject(kind, id) for kind in SubjectKind for id in world.ledger.subjects(kind)]
    keys = (key for subject in subjects for key in keys_of(world, subject, strict=True))
    return tuple(dict.fromkeys(keys))


def services_of(config: Config, name: str) -> Services:
    services = config.services.get(name)
    if services is None:
        message = f"'{name}' is in use, but appdefs/{name} is gone; restore it"
        file = f"appdefs/{name}/appdef.yaml"
        raise Refused.at("type", message, code="unknown-application", file=file)
    return services


# ---- the release at a key ----


def plan(world: World, key: ReleaseKey, *, shaped: bool = True) -> Release | None:
    """Return the release at ``key``, or ``None`` if no claim needs it or an override denies it.

    Without ``shaped``, it is the release without the effects of overrides on it.

    Raises:
        Refused: if claims contradict each other, if a value of a parameter cannot be used, or if
            the configuration no longer has what a claim needs.
    """
    world = without_suspended(world)
    config = world.config
    if not isinstance(key, ServiceKey):
        client = key.type.client(key, _ClaimedConnections(world, key.type), config)
        return overrides.apply_overrides(client, world) if client and shaped else client
    if not (claims := claims_needing(world, key)):
        return None
    claimed: dict[str, list[Application]] = {}
    for claim in claims:
        claimed.setdefault(claim.subject.id, []).append(claim.application)
    # Claims on one application may differ if a person wrote one of them. Its first claim decides
    # the appdef and the nodes, for all of them alike.
    firsts = [world.ledger.application(id) or apps[0] for id, apps in claimed.items()]
    service = services_of(config, firsts[0].appdef)[key.service]
    node, domain = config.node_and_domain(key.node)
    # each application once, with only the inputs that the instance depends on
    parts, further = list[Application](), False
    if service.root is not None:
        source, name = str(key.source), str(key.topic)
        given = (claim.application.inputs_from(service.root, source, name) for claim in claims)
        rooted = [topic for topics in given for topic in topics]
        type = min((topic.type for topic in rooted if topic.type), default="")
        further = all(topic.further for topic in rooted)
        shared = {service.root: (InputTopic(name, source, type, further),)}
        # if all applications give the instance only this one topic, one of them is enough
        needed = firsts if len(service.inputs) > 1 else firsts[:1]
        parts = [first.with_inputs(shared) for first in needed]
    else:
        for first, same in zip(firsts, claimed.values(), strict=True):
            own = {
                role: {
                    topic
                    for app in same
                    for topic in app.inputs.get(role, ())
                    if not service.roots or topic.source == key.node
                }
                for role in service.roots or {role for app in same for role in app.inputs}
            }
            parts.append(first.with_inputs({role: tuple(topics) for role, topics in own.items()}))
    inputs: dict[str, tuple[InputTopic, ...]] = {}
    for role in sorted(service.inputs):
        read = set[InputTopic]()
        for part in parts:  # perhaps of several definitions, which share the service
            origin = services_of(config, part.appdef)[key.service].inputs[role]
            read |= {made.topic for made in topics_of_origin(config, part, origin)}
        # Only some demands name the message type of a topic. An entry without the type sorts first,
        # so the entry with the type replaces it here.
        inputs[role] = tuple({(t.topic, t.source): t for t in sorted(read)}.values())
    # If claims have several values of a parameter, the definition says how they are merged.
    parameters: dict[str, object] = {}
    for name, parameter in sorted(service.parameters.items()):
        giving = [claim for claim in claims if name in claim.application.parameters]
        value = _merged_value(name, parameter, giving) if giving else parameter.default
        if isinstance(parameter.default, float) and value.__class__ is int:
            value = float(value)  # many programs write 10.0 as 10
        parameters[name] = value
    requesters = requesters_of(claims)
    version = version_of_service(world, service, claimed)
    topics = [topic for role_topics in inputs.values() for topic in role_topics]
    chart = version.charts[service.chart]
    chart_values = "\n" + config.files.get(f"{chart.folder}/values.yaml", "")
    release = ServiceRelease(
        key=key,
        name=service_name(config, service, key),
        node=node,
        domain=domain,
        service=service,
        version=version,
        chart=chart,
        restarts=bool(re.search(r"\nreconfigure: *['\"]?restart\b", chart_values)),
        inputs=MappingProxyType(inputs),
        outputs=MappingProxyType(outputs(config, service, key, further=further)),
        parameters=MappingProxyType(parameters),
        replicas=_replicas_of(service.scaling, parameters, topics, claims, requesters),
        applications=tuple(claimed),
        requesters=requesters,
    )
    return overrides.apply_overrides(release, world) if shaped else release


def planned(world: World, keys: Iterable[ReleaseKey]) -> dict[ReleaseKey, Release | None]:
    """Return the releases at ``keys``; one that cannot be planned is None."""
    releases: dict[ReleaseKey, Release | None] = dict.fromkeys(keys)
    for key in releases:
        with suppress(InvalidInput):
            releases[key] = plan(world, key)
    return releases


def denied_release(world: World, key: ReleaseKey) -> tuple[Release, Override] | None:
    release = plan(world, key, shaped=False)
    override = release and overrides.service_denied_by(release, without_suspended(world))
    return (release, override) if release and override else None


def demanded_inputs(
    world: World, release: ServiceRelease, app: Application
) -> Iterator[tuple[str, str]]:
    """Yield (role, topic) for each topic that a service reads for an application."""
    service, key = release.service, release.key
    app = (world.ledger.application(app.id) or app).with_inputs(app.inputs)
    if service.roots:
        roots = {*roots_of(app, service, key)}
        inputs = {
            role: tuple(each for each in topics if (role, each.topic, each.source) in roots)
            for role, topics in app.inputs.items()
        }
        app = app.with_inputs(inputs)
    origins = services_of(world.config, app.appdef)[key.service].inputs
    for role in service.inputs:
        for published in topics_of_origin(world.config, app, origins[role]):
            yield role, published.topic.topic


def service_name(config: Config, service: Service, key: ServiceKey) -> str:
    """Return the release name of a service instance, such as ``od-edge-vehicle00``."""
    if service.root is None:
        return naming.object_name(service.prefix, key.application or key.node)
    source, topic = str(key.source), str(key.topic)
    # Only the inventory makes a topic the usual one here, so a name never depends on other demands.
    further = [] if topic == usual_topic(config, source, service.root) else [topic]
    version = [key.version] if key.version else []
    return naming.object_name(service.prefix, key.node, source, *further, *version)


def _merged_value(name: str, parameter: Parameter, claims: list[Claim]) -> object:
    values = [claim.application.parameters[name] for claim in claims]
    if parameter.merge == "latest":
        latest = max(claims, key=lambda claim: (claim.booked, claim.demand))
        return latest.application.parameters[name]
    if parameter.merge == "union":
        items = [
            item for value in values for item in (value if isinstance(value, list) else [value])
        ]
        # The items may be of any type, and not all types can be compared. As JSON they are sorted
        # in one order on every machine.
        unique = {json.dumps(item, sort_keys=True): item for item in items}
        return [unique[text] for text in sorted(unique)]
    if parameter.merge in ("max", "min"):
        numbers = list[int | float]()
        for value, claim in zip(values, claims, strict=True):
            # In Python a bool is an int, but the maximum of truth values has no meaning.
            if isinstance(value, int | float) and not isinstance(value, bool):
                numbers.append(value)
                continue
            message = (
                f"{strict_yaml.short_repr(value)} for {', '.join(claim.requesters)} is not a "
                f"number, but the application definition merges the values by {parameter.merge}; "
                "give a number"
            )
            raise Refused.at(f"parameters.{name}", message)
        return max(numbers) if parameter.merge == "max" else min(numbers)
    if any(value != values[0] for value in values):
        first: dict[str, Claim] = {}
        for claim in claims:
            first.setdefault(json.dumps(claim.application.parameters[name]), claim)
        shown = " and ".join(
            f"{value} for {', '.join(claim.requesters)}" for value, claim in [*first.items()][:3]
        )
        message = (
            f"demands contradict each other: {shown}; demand the same value, or ask that the "
            "application definition say how to merge the values"
        )
        raise Refused.at(f"parameters.{name}", message, code="conflict")
    return values[0]


@dataclass(frozen=True, slots=True)
class _ClaimedConnections:
    world: World
    type: ConnectionType

    def at(self, node: str) -> Iterable[str]:
        return self.world.ledger.ids_with("link", self.type.name, node)

    def get(self, id: str) -> Connection | None:
        first, claims = self.world.ledger.connection(id), self.world.ledger.connection_claims(id)
        if first is None or first.type is not self.type:
            return None
        topics = tuple(
            route
            for route in connection_topics(claims)
            if not is_bridged(first.key_of(route), self.world.config)
        )
        brokers = (claim.connection.broker for claim in claims)
        united = replace(first, broker=next(filter(None, brokers), ""), topics=topics)
        # A person may have written a claim with a route that this type cannot carry, or have
        # removed from the inventory what the connection needs.
        if problems := list(route_faults(self.type, united, self.world.config)):
            raise Refused(
                replace(problem, field="connections", message=f"'{id}': {problem.message}")
                for problem in problems
            )
        return united


def connection_topics(claims: Iterable[Claim]) -> tuple[Route, ...]:
    topics = (route for claim in claims for route in claim.connection.topics)
    return routes.merged_routes(
        replace(route, implied=False, listed="") if route.implied or route.listed else route
        for route in topics
    )


def _replicas_of(
    scaling: Scaling,
    parameters: Mapping[str, object],
    topics: Collection[InputTopic],
    claims: Collection[Claim],
    requesters: Collection[str],
) -> int | Autoscaler:
    if scaling.autoscaler:
        return Autoscaler(scaling.min, scaling.max, scaling.autoscaler)
    if scaling.sizes:
        name = scaling.sizes.parameter
        replicas = scaling.sizes.replicas_for(parameters[name])
        if replicas is None:
            value = parameters[name]
            message = f"{strict_yaml.short_repr(value)} is not a size" + suggestion(
                str(value), scaling.sizes.replicas
            )
            raise Refused.at(f"parameters.{name}", message)
        return replicas
    for measure, share in (scaling.per or {}).items():
        sources = {topic.source for topic in topics}
        counted = {"topics": topics, "sources": sources, "claims": claims, "requesters": requesters}
        needed = -(-len(counted[measure]) // share)  # rounded up
        return max(scaling.min, min(scaling.max, needed))
    return scaling.min
