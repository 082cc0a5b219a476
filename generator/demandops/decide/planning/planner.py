"""The planner: :func:`plan` returns the release that claims need at a key.

The keys come from :mod:`.release_keys`. A release follows from the ledger and the
configuration alone, so every generator and every replay of a commit plans the same.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from demandops.base import naming, strict_yaml
from demandops.base.errors import Refused, suggestion
from demandops.connections import connection as routes
from demandops.connections.connection import Connection, ConnectionType, Route
from demandops.decide.admission.admission import route_faults
from demandops.decide.planning import overrides, release_keys
from demandops.decide.planning.flows import (
    is_bridged,
    outputs,
    roots_of,
    topics_of_origin,
    usual_topic,
)
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.planning.release_keys import ReleaseKey
from demandops.model.config.appdef import Parameter, Scaling, Service
from demandops.model.config.config import Config
from demandops.model.config.override import Override
from demandops.model.demand.demand import Application, InputTopic
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.ledger.ledger import World
from demandops.model.release import Autoscaler, Release, ServiceKey, ServiceRelease


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
    if not (claims := release_keys.claims_needing(world, key)):
        return None
    claimed: dict[str, list[Application]] = {}
    for claim in claims:
        claimed.setdefault(claim.subject.id, []).append(claim.application)
    # Claims on one application may differ if a person wrote one of them. Its first claim decides
    # the appdef and the nodes, for all of them alike.
    firsts = [world.ledger.application(id) or apps[0] for id, apps in claimed.items()]
    service = release_keys.services_of(config, firsts[0].appdef)[key.service]
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
            origin = release_keys.services_of(config, part.appdef)[key.service].inputs[role]
            read |= {made.topic for made in topics_of_origin(config, part, origin)}
        # Only some demands name the message type of a topic. An entry without the type sorts first,
        # so the entry with the type replaces it here.
        inputs[role] = tuple({(t.topic, t.source): t for t in sorted(read)}.values())
    # If claims have several values of a parameter, the definition says how they are merged.
    parameters: dict[str, object] = {}
    for name, parameter in sorted(service.parameters.items()):
        giving = [claim for claim in claims if name in claim.application.parameters]
        parameters[name] = _merged_value(name, parameter, giving) if giving else parameter.default
    requesters = requesters_of(claims)
    version = release_keys.version_of_service(world, service, claimed)
    topics = [topic for role_topics in inputs.values() for topic in role_topics]
    release = ServiceRelease(
        key=key,
        name=service_name(config, service, key),
        node=node,
        domain=domain,
        service=service,
        version=version,
        chart=version.charts[service.chart],
        inputs=MappingProxyType(inputs),
        outputs=MappingProxyType(outputs(config, service, key, further=further)),
        parameters=MappingProxyType(parameters),
        replicas=_replicas_of(service.scaling, parameters, topics, claims, requesters),
        applications=tuple(claimed),
        requesters=requesters,
    )
    return overrides.apply_overrides(release, world) if shaped else release


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
    origins = release_keys.services_of(world.config, app.appdef)[key.service].inputs
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
