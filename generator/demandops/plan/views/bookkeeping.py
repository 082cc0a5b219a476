"""Bookkeeping: what is demanded, and for each service, connection and topic, who requests it.

This is Table III, column 4, of the paper. It is derived from claims and stored nowhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

from demandops.demand.claim import Claim, requesters_of
from demandops.ledger.world import World
from demandops.plan.overrides.claim_overrides import suspended_claims, without_suspended
from demandops.plan.planner import connection_topics, demanded_inputs
from demandops.plan.release import ServiceRelease, claims_of
from demandops.plan.views import release_causes
from demandops.subject import SubjectKind

_Requesters: TypeAlias = dict[str, list[str]]
"""Topic → who requests it, sorted."""


@dataclass(frozen=True, slots=True)
class ServiceEntry:
    """One service, its requesters and those of its inputs (role → topic → requesters).

    ``version`` is its chart's, ``application_version`` that of ``registry/versions.yaml``.
    ``versions_asked`` has the requesters of each version that claims name.
    """

    applications: list[str]
    service: str
    node: str
    source: str | None
    source_topic: str | None
    version: str
    application_version: str | None
    versions_asked: dict[str, list[str]]
    parameters: dict[str, object]
    inputs: dict[str, _Requesters]
    requesters: list[str]


@dataclass(frozen=True, slots=True)
class ConnectionEntry:
    """One connection, its requesters and those of each source topic that it carries."""

    type: str
    source: str
    target: str
    topics: _Requesters
    requesters: list[str]


@dataclass(frozen=True, slots=True)
class SuspendedEntry:
    """A booked claim that is not planned, and the override that suspends it."""

    kind: str
    id: str
    demand: str
    requesters: list[str]
    override: str
    reason: str


@dataclass(frozen=True, slots=True)
class Bookkeeping:
    """The whole view: services by release name, connections by id, both sorted.

    ``suspended`` are the claims that an override suspends; they are in neither list.
    """

    services: dict[str, ServiceEntry]
    connections: dict[str, ConnectionEntry]
    suspended: list[SuspendedEntry]


def bookkeeping(world: World) -> Bookkeeping:
    """Return what runs and who requests it."""
    active = without_suspended(world)
    services = {
        release.name: ServiceEntry(
            applications=list(release.applications),
            service=release.key.service,
            node=release.node.id,
            source=release.key.source,
            source_topic=release.key.topic,
            version=release.chart.version,
            application_version=release.version.name or None,
            versions_asked=release_causes.versions_asked(release, active.ledger),
            parameters=dict(release.parameters),
            inputs=_requesters_of_inputs(release, active),
            requesters=list(release.requesters),
        )
        for release in release_causes.releases(world)
        if isinstance(release, ServiceRelease)
    }
    connections = {}
    for id in world.ledger.subjects(SubjectKind.CONNECTION):
        first, claims = active.ledger.connection(id), active.ledger.connection_claims(id)
        if first is None or not claims:
            continue
        connections[id] = ConnectionEntry(
            type=first.type.word if first.type else "",
            source=first.source,
            target=first.target,
            topics=_requesters_of_topics(claims),
            requesters=list(requesters_of(claims)),
        )
    suspended = [
        SuspendedEntry(
            claim.subject.kind.value[:-1],
            claim.subject.id,
            claim.demand,
            list(claim.requesters),
            override.path,
            override.reason,
        )
        for claim, override in suspended_claims(world)
    ]
    return Bookkeeping(dict(sorted(services.items())), connections, suspended)


def _requesters_of_topics(claims: Iterable[Claim]) -> _Requesters:
    found = {route.source: set[str]() for route in connection_topics(claims)}
    for claim in claims:
        for key in claim.held.topic_keys():
            found[key[0]].update(claim.holders(key))
    return _sorted(found)


def _requesters_of_inputs(release: ServiceRelease, active: World) -> dict[str, _Requesters]:
    found = {role: {one.topic: set[str]() for one in of} for role, of in release.inputs.items()}
    for claim in claims_of(release, active.ledger):
        for role, topic, key in demanded_inputs(active, release, claim.application):
            if topic in found[role]:  # a claim that a person wrote may name it otherwise
                found[role][topic].update(claim.holders(key))
    return {role: _sorted(topics) for role, topics in found.items()}


def _sorted(topics: dict[str, set[str]]) -> _Requesters:
    return {topic: sorted(who) for topic, who in topics.items()}


def as_data(view: Bookkeeping, commit: str) -> dict[str, Any]:
    """Return the bookkeeping as plain data, the contract of ``bookkeeping --output json``.

    ``suspended`` is left out if it is empty.
    """
    data = asdict(view) | {"commit": commit}
    if not view.suspended:
        del data["suspended"]
    return data


@dataclass(frozen=True, slots=True)
class EntryChange:
    """One service or connection that was added, changed or removed.

    ``requesters`` are the current ones, or the last ones if it was removed. ``lost`` and ``gained``
    list what changed.
    """

    kind: Literal["service", "connection"]
    name: str
    change: Literal["added", "changed", "removed"]
    requesters: list[str]
    lost: tuple[str, ...] = ()
    gained: tuple[str, ...] = ()


def bookkeeping_changes(old: Bookkeeping, new: Bookkeeping) -> tuple[EntryChange, ...]:
    """Return every entry that differs: services, then connections, each sorted by name."""
    return (
        *_changes("service", dict(old.services), dict(new.services)),
        *_changes("connection", dict(old.connections), dict(new.connections)),
    )


_Entry = ServiceEntry | ConnectionEntry


def _changes(
    kind: Literal["service", "connection"], old: dict[str, _Entry], new: dict[str, _Entry]
) -> Iterator[EntryChange]:
    for name in sorted({*old, *new}):
        if name not in new:
            yield EntryChange(kind, name, "removed", old[name].requesters)
        elif name not in old:
            yield EntryChange(kind, name, "added", new[name].requesters)
        elif old[name] != new[name]:
            had, has = list(_facts(old[name], new[name])), list(_facts(new[name], old[name]))
            lost = tuple(fact for fact in had if fact not in has)
            gained = tuple(fact for fact in has if fact not in had)
            yield EntryChange(kind, name, "changed", new[name].requesters, lost, gained)


def _facts(entry: _Entry, other: _Entry) -> Iterator[str]:
    """Yield what is to be said of an entry where it differs from another of the same name."""
    yield from (f"requester {requester}" for requester in entry.requesters)
    if isinstance(entry, ConnectionEntry):
        yield f"from {entry.source} to {entry.target}"
        yield f"by {entry.type}"
    else:
        yield f"on {entry.node}"
        yield from (f"for {application}" for application in entry.applications)
        yield f"version {entry.version}"
        if entry.application_version:
            yield f"application version {entry.application_version}"
        for version, requesters in entry.versions_asked.items():
            yield f"version {version} for {', '.join(requesters)}"
        yield from (f"{name} = {value}" for name, value in sorted(entry.parameters.items()))
    topics, known = _topics(entry), _topics(other)
    for what, who in sorted(topics.items()):
        yield what
        # who comes or goes altogether is named above
        yield from (f"{what} for {one}" for one in who if what in known and one in other.requesters)


def _topics(entry: _Entry) -> _Requesters:
    inputs = {"topic": entry.topics} if isinstance(entry, ConnectionEntry) else entry.inputs
    return {f"{role} {topic}": who for role, of in inputs.items() for topic, who in of.items()}
