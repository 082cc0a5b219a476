"""Which releases claims need, by key, and which of them a change of claims affects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from demandops.base.errors import Refused
from demandops.base.naming import Subject, SubjectKind
from demandops.connections.connection import ClientKey
from demandops.decide.planning.flows import instances, node_of, roots_of, version_of_instance
from demandops.decide.planning.overrides import without_suspended
from demandops.model.config.appdef import Service, Services
from demandops.model.config.config import VERSIONS_FILE, Config
from demandops.model.config.registry import ApplicationVersion, precedence
from demandops.model.demand.demand import Application
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import ClaimChange, Ledger, World
from demandops.model.release import ServiceKey

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
            assert connection.type is not None, connection.id  # noqa: S101 - a claim has one
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
