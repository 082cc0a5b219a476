"""The keys of the releases that claims need, and of those that a change of claims affects.

Only the releases that :func:`affected_keys` returns are planned again for a demand, so the cost of
a demand does not grow with the number of other demands. :mod:`demandops.plan.planner` plans the
release at each key.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from demandops.config.appdef import Service, Services
from demandops.config.config import Config
from demandops.connections.connection_type import ClientKey
from demandops.demand.application import Application
from demandops.demand.claim import Claim
from demandops.errors import Refused
from demandops.ledger.claim_changes import ClaimChange
from demandops.ledger.world import World
from demandops.plan.flows import instances, node_of, roots_of, version_of_instance
from demandops.plan.overrides.claim_overrides import without_suspended
from demandops.plan.release import ServiceKey
from demandops.plan.running_version import running_version, same_version
from demandops.subject import Subject, SubjectKind

ReleaseKey = ServiceKey | ClientKey


def keys_of(world: World, subject: Subject, *, strict: bool = False) -> Iterator[ReleaseKey]:
    """Yield the keys of the releases that the unsuspended claims on ``subject`` need.

    If the definition of the application is missing, nothing is yielded. With ``strict``, this
    raises ``Refused`` instead, so that no service ends because its definition was deleted.
    """
    world = without_suspended(world)
    yield from keys_of_claims(world, world.ledger.claims_on(subject), strict=strict)


def keys_of_claims(
    world: World, claims: Iterable[Claim], *, strict: bool = False
) -> Iterator[ReleaseKey]:
    """Yield the keys of the releases that ``claims`` need in ``world``, each once.

    ``strict`` means the same as for :func:`keys_of`.
    """
    keys = (
        key
        for claim in claims
        for key in (
            _service_keys(world, claim, strict)
            if claim.is_on_application
            else _client_keys(world, claim)
        )
    )
    yield from dict.fromkeys(keys)


def _client_keys(world: World, claim: Claim) -> Iterable[ClientKey]:
    first = world.ledger.connection(claim.subject.id) or claim.connection
    return first.known_type.keys(first.id, *first.nodes)


def _service_keys(world: World, claim: Claim, strict: bool) -> Iterator[ServiceKey]:
    app = claim.application
    first = world.ledger.application(app.id) or app
    known = strict or first.appdef in world.config.services
    app = app.moved_to_nodes_of(first)
    for service in services_of(world.config, first.appdef).values() if known else ():
        yield from instances(app, service)


def claims_needing(world: World, key: ServiceKey) -> tuple[Claim, ...]:
    """Return the claims that need a service instance.

    They are sorted by application and demand. For a service that runs once for each cluster, they
    are grouped by appdef first. Callers pass a world without suspended claims if these must not
    count.
    """
    ledger = world.ledger
    if key.application is not None:
        needed = _service(world, key.application, key) is not None
        return ledger.application_claims(key.application) if needed else ()
    topic = (str(key.source), str(key.topic))
    if key.for_cluster:
        users = world.config.users_of(key.service)
        claims = tuple(one for name in users for one in ledger.claims_of_definition(name))
    else:
        claims = (
            ledger.claims_at(key.node) if key.scope == "node" else ledger.claims_reading(*topic)
        )
    services = {id: _service(world, id, key) for id in {one.subject.id for one in claims}}
    return tuple(
        one
        for one in claims
        if (service := services[one.subject.id]) and takes(one.application, service, key)
    )


def is_needed(world: World, key: ReleaseKey) -> bool:
    """Return whether a claim needs a service instance or a client.

    Callers pass a world without suspended claims if these must not count.
    """
    if isinstance(key, ClientKey):
        if key.side is None:
            return bool(world.ledger.connections_at(key.type, key.id))
        connection = world.ledger.connection(key.id)
        return connection is not None and connection.type is key.type
    if key.application is not None:
        return _service(world, key.application, key) is not None
    if key.scope in ("node", "cluster"):
        return bool(claims_needing(world, key))
    return any(
        service is not None and takes(one.application, service, key)
        for one in world.ledger.each_reading(str(key.source), str(key.topic))
        for service in (_service(world, one.subject.id, key),)
    )


def takes(app: Application, service: Service, key: ServiceKey) -> bool:
    """Return whether an application whose appdef has ``service`` needs the instance at ``key``."""
    return not service.roots or bool(roots_of(app, service, key))


def _service(world: World, application: str, key: ServiceKey) -> Service | None:
    """Return the application's service to which the instance at ``key`` may belong.

    Return ``None`` if the application has no such service, or if the instance cannot belong to it,
    for example because the application moved to another node.
    """
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

    Raises:
        Refused: if an application definition that ``after`` needs is missing.
    """
    before, after = without_suspended(before), without_suspended(after)
    keys: dict[ReleaseKey, None] = {}
    for change in changes:
        subject, claims = change.key.subject, _differing(change, after)
        for world, claim in zip((before, after), claims, strict=True):
            own = [claim] if claim and world.ledger.get(claim.key) else []
            if not _has_same_place_and_version(before, after, subject):
                own += world.ledger.claims_on(subject)
            keys |= dict.fromkeys(keys_of_claims(world, own, strict=world is after))
    return tuple(keys)


def _differing(change: ClaimChange, world: World) -> tuple[Claim | None, Claim | None]:
    """Return the claim before and the claim after a change, reduced to what differs.

    If the claims differ only in inputs, the inputs that are in both claims are left out of both.
    Otherwise both claims are returned whole. A difference in requesters counts only if a service
    definition or an override depends on the requesters.
    """
    before, after = change.before, change.after
    if before is None or after is None or not before.is_on_application:
        return before, after
    old, new = before.application, after.application
    same = replace(new, inputs=old.inputs) == old
    if not same or old.parameters:  # a parameter's value may depend on the booking times
        return before, after
    others = (before.requesters, before.partial) != (after.requesters, after.partial)
    if others and _looks_at_requesters(new.appdef, world):
        return before, after
    return (
        replace(before, held=_with_inputs_not_in(old, new)),
        replace(after, held=_with_inputs_not_in(new, old)),
    )


def _looks_at_requesters(appdef: str, world: World) -> bool:
    selectors = (selector for override in world.overrides for selector in override.select)
    services = world.config.services.get(appdef, {}).values()
    return any(selector.requesters for selector in selectors) or any(
        service.scaling.may_depend_on_requesters for service in services
    )


def _with_inputs_not_in(app: Application, other: Application) -> Application:
    inputs = {}
    for role, topics in app.inputs.items():
        known = {*other.inputs.get(role, ())}
        inputs[role] = tuple(topic for topic in topics if topic not in known)
    return app.with_inputs(inputs)


def _has_same_place_and_version(before: World, after: World, subject: Subject) -> bool:
    """Return whether an application has the same nodes, appdef and version in both worlds.

    Return ``True`` for a connection, and for an application that only one world has.
    """
    if subject.kind is not SubjectKind.APPLICATION:
        return True
    one, other = before.ledger.application(subject.id), after.ledger.application(subject.id)
    if not one or not other:
        return True
    versions = (running_version(world, subject.id) for world in (before, after))
    return one.has_same_definition_and_nodes(other) and same_version(*versions)


def all_keys(world: World) -> tuple[ReleaseKey, ...]:
    """Return the key of every release that the ledger needs.

    Raises:
        Refused: if the definition of a claimed application is missing.
    """
    subjects = [Subject(kind, id) for kind in SubjectKind for id in world.ledger.subjects(kind)]
    keys = (key for s in subjects for key in keys_of(world, s, strict=True))
    return tuple(dict.fromkeys(keys))


def services_of(config: Config, name: str) -> Services:
    """Return the services of an application definition.

    Raises:
        Refused: if the state repo has no such definition.
    """
    services = config.services.get(name)
    if services is None:
        message = f"'{name}' is in use, but appdefs/{name} is gone; restore it"
        file = f"appdefs/{name}/appdef.yaml"
        raise Refused.at("appdef", message, code="unknown-application", file=file)
    return services
