"""The planner: :func:`plan` returns the release that claims need at a key.

The keys come from :mod:`demandops.plan.release_keys`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeGuard

from demandops import naming, strict_yaml
from demandops.config.appdef import Parameter, Service
from demandops.config.config import Config
from demandops.config.override import Override
from demandops.connections import route as routes
from demandops.connections.connection import Connection
from demandops.connections.connection_type import ConnectionType
from demandops.connections.connection_types import route_faults
from demandops.connections.route import Route
from demandops.demand.application import Application, InputTopic
from demandops.demand.claim import Claim, requesters_of
from demandops.errors import Refused
from demandops.ledger.world import World
from demandops.plan.flows import roots_of, topics_of_origin
from demandops.plan.output_topics import outputs, usual_topic
from demandops.plan.overrides import release_overrides
from demandops.plan.overrides.claim_overrides import without_suspended
from demandops.plan.release import Release, ServiceKey, ServiceRelease
from demandops.plan.release_keys import ReleaseKey, claims_needing, services_of
from demandops.plan.replicas import replicas_of, with_kept
from demandops.plan.running_version import version_of_service
from demandops.subject import TopicKey


def plan(world: World, key: ReleaseKey) -> Release | None:
    """Return the release at ``key`` with the effects of overrides.

    Return ``None`` if no claim needs the release, or if an override denies it.

    Raises:
        Refused: if claims contradict each other in a parameter; if the value of a parameter cannot
            be used; if application definitions that share a service pin different images of one
            chart version; or if the configuration no longer has what a claim needs.
    """
    world = without_suspended(world)
    release = _unshaped(world, key)
    return release_overrides.apply_overrides(release, world) if release else None


def without_kept(world: World, key: ServiceKey) -> ServiceRelease | None:
    """Return the release of a service as demands need it, or ``None`` if no claim needs it.

    The release has neither kept replicas nor the effects of overrides.

    Raises:
        Refused: for the same reasons as :func:`plan`.
    """
    world = without_suspended(world)
    kept = world.ledger.kept.replace(key.instance, ())
    return _service(replace(world, ledger=replace(world.ledger, kept=kept)), key)


def denied_release(world: World, key: ReleaseKey) -> tuple[Release, Override] | None:
    """Return the release at ``key`` and the override that denies it.

    Return ``None`` if no override denies it, or if no claim needs it.

    Raises:
        Refused: for the same reasons as :func:`plan`.
    """
    world = without_suspended(world)
    release = _unshaped(world, key)
    by = release_overrides.service_denied_by(release, world) if release else None
    return (release, by) if release and by else None


def _unshaped(world: World, key: ReleaseKey) -> Release | None:
    if isinstance(key, ServiceKey):
        return _service(world, key)
    return key.type.client(key, _ClaimedConnections(world, key.type), world.config)


def _service(world: World, key: ServiceKey) -> ServiceRelease | None:
    config, claims = world.config, claims_needing(world, key)
    if not claims:
        return None
    apps = [claim.application for claim in claims]
    service = services_of(config, _as_claimed(world, apps[0]).appdef)[key.service]
    node, domain = config.node_and_domain(key.node)
    parts = list(_parts(world, service, key, apps))
    inputs = {role: _inputs(config, key, role, parts) for role in sorted(service.inputs)}
    topics = [one for read in inputs.values() for one in read]
    parameters = _merged_parameters(service.parameters, claims)
    requesters = _requesters(claims, service, key)
    further = service.root is not None and parts[0].inputs[service.root][0].further
    applications = tuple(dict.fromkeys(app.id for app in apps))
    version = version_of_service(world, service, applications)
    needed = replicas_of(service.scaling, parameters, topics, claims, requesters)
    kept = world.ledger.kept.steps.get(key.instance)
    replicas, keeps = with_kept(needed, service.scaling, kept or ())
    return ServiceRelease(
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
        replicas=replicas,
        keeps=keeps,
        applications=applications,
        requesters=requesters,
    )


def _as_claimed(world: World, app: Application) -> Application:
    """Return an application as its first claim has it; that claim decides the appdef and nodes."""
    return world.ledger.application(app.id) or app


def _requesters(claims: Iterable[Claim], service: Service, key: ServiceKey) -> tuple[str, ...]:
    """Return the requesters of a service instance.

    If the instance runs for certain topics, only the requesters that hold one of these topics are
    returned.
    """
    if not service.roots:
        return requesters_of(claims)
    holders = (
        claim.holders(topic)
        for claim in claims
        for topic in roots_of(claim.application, service, key)
    )
    return tuple(sorted({who for names in holders for who in names}))


def _parts(
    world: World, service: Service, key: ServiceKey, apps: Iterable[Application]
) -> Iterator[Application]:
    """Yield each application with only those inputs that the instance at ``key`` depends on.

    Several claims on one application give one application with the inputs of all these claims. If
    the instance reads only the topic that it runs for, only one application is yielded.
    """
    by_id: dict[str, list[Application]] = {}
    for app in apps:
        by_id.setdefault(app.id, []).append(app)
    shared = service.root and {service.root: (_shared_input(apps, service.root, key),)}
    for same in by_id.values():
        first = _as_claimed(world, same[0])
        if shared:
            yield first.with_inputs(shared)
            if len(service.inputs) == 1:
                return
            continue
        roles = service.roots or {role for app in same for role in app.inputs}
        united = {role: {one for app in same for one in app.inputs.get(role, ())} for role in roles}
        if service.roots:
            united = {r: {one for one in of if one.source == key.node} for r, of in united.items()}
        yield first.with_inputs({role: tuple(of) for role, of in united.items()})


def _shared_input(apps: Iterable[Application], role: str, key: ServiceKey) -> InputTopic:
    source, topic = str(key.source), str(key.topic)
    found = [one for app in apps for one in app.inputs_from(role, source, topic)]
    type = min((one.type for one in found if one.type), default="")
    return InputTopic(topic, source, type, all(one.further for one in found))


def _inputs(
    config: Config, key: ServiceKey, role: str, parts: Iterable[Application]
) -> tuple[InputTopic, ...]:
    """Return the topics that an instance reads in a role, sorted.

    A topic has its message type if a demand names the type.
    """
    found: set[InputTopic] = set()
    for part in parts:
        origin = _origin(config, key, role, part)
        if "." in origin:
            found.update(one.topic for one in topics_of_origin(config, part, origin))
        else:
            found.update(part.inputs.get(origin, ()))
    return tuple({one[:2]: one for one in sorted(found)}.values())


def _origin(config: Config, key: ServiceKey, role: str, app: Application) -> str:
    return services_of(config, app.appdef)[key.service].inputs[role]


def demanded_inputs(
    world: World, release: ServiceRelease, app: Application
) -> Iterator[tuple[str, str, TopicKey]]:
    """Yield (role, topic, root) for each topic that a service reads because of an application.

    ``role`` is the service's input that reads the topic. ``root`` is the key of the demanded topic
    from which this topic comes, or empty (:class:`demandops.plan.flows.PublishedTopic`).
    """
    service, key = release.service, release.key
    app = _as_claimed(world, app).with_inputs(app.inputs)
    if service.roots:
        kept = {*roots_of(app, service, key)}
        left = {
            role: tuple(one for one in of if (role, one.topic, one.source) in kept)
            for role, of in app.inputs.items()
        }
        app = app.with_inputs(left)
    for role in service.inputs:
        for one in topics_of_origin(world.config, app, _origin(world.config, key, role, app)):
            yield role, one.topic.topic, one.root


def service_name(config: Config, service: Service, key: ServiceKey) -> str:
    """Return the release name of a service instance.

    If the instance runs for a topic, the name contains the node and the topic's source, as in
    ``od-edge-vehicle00``. The name also contains a slug of the topic, unless ``topics`` in the
    source's inventory entry lists the topic as the usual one. For a separate instance, the name
    also contains the version.
    """
    if service.root is None:
        return naming.object_name(service.prefix, key.application or key.node)
    source, topic = str(key.source), str(key.topic)
    further = [] if topic == usual_topic(config, source, service.root) else [topic]
    version = [key.version] if key.version else []
    return naming.object_name(service.prefix, key.node, source, *further, *version)


def _merged_parameters(
    definitions: Mapping[str, Parameter], claims: Iterable[Claim]
) -> dict[str, object]:
    """Return the value of every parameter of a service.

    If claims have several values of a parameter, the appdef says how the values are merged.
    """
    values: dict[str, object] = {}
    claims = [claim for claim in claims if claim.application.parameters]
    for name, parameter in sorted(definitions.items()):
        given = [claim for claim in claims if name in claim.application.parameters]
        values[name] = _merged_value(name, parameter, given) if given else parameter.default
    return values


def _merged_value(name: str, parameter: Parameter, claims: list[Claim]) -> object:
    given = [claim.application.parameters[name] for claim in claims]
    if parameter.merge == "latest":
        latest = max(claims, key=lambda claim: (claim.booked, claim.demand))
        return latest.application.parameters[name]
    if parameter.merge == "union":
        items = [
            item for value in given for item in (value if isinstance(value, list) else [value])
        ]
        unique = {json.dumps(item, sort_keys=True): item for item in items}
        return [unique[key] for key in sorted(unique)]
    if parameter.merge in ("max", "min"):
        numbers = [value for value in given if _is_number(value)]
        if len(numbers) != len(given):
            odd, claim = next(
                (value, claim)
                for value, claim in zip(given, claims, strict=True)
                if not _is_number(value)
            )
            message = (
                f"{strict_yaml.short_repr(odd)} for {', '.join(claim.requesters)} is not a number, "
                f"but the application definition merges the values by {parameter.merge}; give a "
                "number"
            )
            raise Refused.at(f"parameters.{name}", message)
        return max(numbers) if parameter.merge == "max" else min(numbers)
    if any(value != given[0] for value in given):
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
    return given[0]


def _is_number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True, slots=True)
class _ClaimedConnections:
    world: World
    type: ConnectionType

    def at(self, node: str) -> Iterable[str]:
        """Return the ids of the connections that end at a node, sorted."""
        return self.world.ledger.connections_at(self.type, node)

    def get(self, id: str) -> Connection | None:
        """Return the connection with an id, or ``None`` if no connection of :attr:`type` has it.

        Raises:
            Refused: if a person wrote a claim with a route that this type cannot carry, or
                removed from the inventory what the connection needs.
        """
        first, claims = self.world.ledger.connection(id), self.world.ledger.connection_claims(id)
        if first is None or first.type is not self.type:
            return None
        topics = tuple(
            route
            for route in connection_topics(claims)
            if not is_bridged(route, *first.nodes, self.world.config)
        )
        problems = list(route_faults(self.type, topics, first.nodes, self.world.config))
        if problems:
            raise Refused(
                replace(one, field="connections", message=f"'{id}': {one.message}")
                for one in problems
            )
        brokers = (claim.connection.broker for claim in claims)
        return replace(first, broker=next(filter(None, brokers), ""), topics=topics)


def connection_topics(claims: Iterable[Claim]) -> tuple[Route, ...]:
    """Return one route for each source topic that claims on a connection list, sorted by topic."""
    return routes.merged_routes(route for claim in claims for route in claim.connection.topics)


def is_bridged(route: Route, source: str, target: str, config: Config) -> bool:
    """Return whether the initial deployment already carries a route between two nodes.

    ``bridged`` in the inventory lists what the initial deployment carries. The initial deployment
    keeps topic names, so it carries no route that renames a topic.
    """
    sender, receiver = route.sender_and_receiver(source, target)
    node = config.nodes.get(sender)
    if node is None or route.source != route.target:
        return False
    return route.read_topic in node.bridged.get(receiver, ())
