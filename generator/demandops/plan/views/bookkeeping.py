"""Bookkeeping: who requests each service, connection and topic, and what each demand holds.

The paper shows the bookkeeping in Table III, column 4. The bookkeeping is derived from the claims
whenever it is shown, and is stored nowhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Literal, TypeAlias

from demandops.config.inventory import amount_text
from demandops.demand.claim import Claim, requesters_of
from demandops.ledger.waiting import in_turn
from demandops.ledger.world import World
from demandops.plan.nodes.capacity import whole_usage
from demandops.plan.overrides.claim_overrides import suspended_claims, without_suspended
from demandops.plan.planner import connection_topics, demanded_inputs
from demandops.plan.release import ServiceRelease, claims_of
from demandops.plan.views import release_causes
from demandops.subject import Subject, SubjectKind

_LEFT_OUT = ("demands", "suspended", "nodes", "waiting")
_Requesters: TypeAlias = dict[str, list[str]]
"""Topic → the requesters of the topic, sorted."""


@dataclass(frozen=True, slots=True)
class ServiceEntry:
    """One running service and its requesters.

    ``inputs`` maps each input role to its topics, and each topic to its requesters. ``version`` is
    the version of the service's chart. ``application_version`` is the version of the application in
    ``registry/versions.yaml``, or ``None``. ``versions_asked`` maps each version that a demand
    names to the requesters of such demands.
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
    """One connection and its requesters; ``topics`` has the requesters of each source topic."""

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
class WaitingEntry:
    """A demand that waits for room, and since when."""

    demand: str
    requesters: list[str]
    since: str
    priority: int


@dataclass(frozen=True, slots=True)
class ResourceEntry:
    """What services request of a node's resource, and the capacity, as Kubernetes quantities."""

    requested: str
    capacity: str


@dataclass(frozen=True, slots=True)
class DemandEntry:
    """One demand that holds claims. ``action`` is the ROS action that takes such a demand."""

    action: Literal["Demand", "DeploymentRequest"]
    request: str
    requesters: list[str]


@dataclass(frozen=True, slots=True)
class Bookkeeping:
    """The whole view: services by release name, connections and demands by id, all sorted.

    ``demands`` includes demands whose claims are suspended. ``suspended`` are the claims that
    overrides suspend; no service or connection counts them. ``nodes`` are the nodes that declare a
    capacity, each with its resources. ``waiting`` are the demands that wait for room, in the order
    in which the generator tries to book them.
    """

    services: dict[str, ServiceEntry]
    connections: dict[str, ConnectionEntry]
    demands: dict[str, DemandEntry]
    suspended: list[SuspendedEntry]
    nodes: dict[str, dict[str, ResourceEntry]]
    waiting: list[WaitingEntry]


def bookkeeping(world: World) -> Bookkeeping:
    """Return what runs and who requests it.

    Raises:
        Refused: for the same reasons as :func:`demandops.plan.planner.plan`.
    """
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
    waiting = [
        WaitingEntry(one.demand, list(one.requesters), _time(one.since), one.priority)
        for one in in_turn(world.ledger.waiting)
    ]
    return Bookkeeping(
        dict(sorted(services.items())),
        connections,
        _demands(world),
        suspended,
        _nodes(world),
        waiting,
    )


def _time(moment: datetime) -> str:
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def _nodes(world: World) -> dict[str, dict[str, ResourceEntry]]:
    usage = whole_usage(world)
    found: dict[str, dict[str, ResourceEntry]] = {}
    machines = {id: one for id, one in world.config.nodes.items() if id not in world.config.hosts}
    for id, node in sorted(machines.items()):
        listed = {*(node.capacity or ()), *(name for at, name in usage.amounts if at == id)}
        limits = ((name, node.most(name)) for name in sorted(listed))
        resources = {
            name: ResourceEntry(amount_text(usage.of(id, name), name), amount_text(most, name))
            for name, most in limits
            if most is not None
        }
        found |= {id: resources} if resources else {}
    return found


def _demands(world: World) -> dict[str, DemandEntry]:
    """Return an entry for each demand that holds claims, by demand id.

    Claims that overrides keep belong to no demand, so they are left out.
    """
    found: dict[str, list[Claim]] = {}
    for kind in SubjectKind:
        for id in world.ledger.subjects(kind):
            for claim in world.ledger.claims_on(Subject(kind, id)):
                if claim.keeping_override is None:
                    found.setdefault(claim.demand, []).append(claim)
    return {
        demand: DemandEntry(
            "DeploymentRequest" if claims[0].joined else "Demand",
            claims[0].request,
            list(requesters_of(claims)),
        )
        for demand, claims in sorted(found.items())
    }


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
            if topic in found[role]:  # a claim that a person wrote may name another topic
                found[role][topic].update(claim.holders(key))
    return {role: _sorted(topics) for role, topics in found.items()}


def _sorted(topics: dict[str, set[str]]) -> _Requesters:
    return {topic: sorted(who) for topic, who in topics.items()}


def as_data(view: Bookkeeping, commit: str) -> dict[str, Any]:
    """Return the bookkeeping as plain data, as ``bookkeeping --output json`` prints it.

    ``demands``, ``suspended``, ``nodes`` and ``waiting`` are left out if they are empty.
    """
    data = asdict(view) | {"commit": commit}
    return {name: part for name, part in data.items() if part or name not in _LEFT_OUT}


@dataclass(frozen=True, slots=True)
class EntryChange:
    """One service or connection that was added, changed or removed.

    ``requesters`` are the requesters after the change. If the entry was removed, they are those
    before the change. If the entry was changed, ``lost`` has the facts that no longer hold, and
    ``gained`` has the new facts.
    """

    kind: Literal["service", "connection"]
    name: str
    change: Literal["added", "changed", "removed"]
    requesters: list[str]
    lost: tuple[str, ...] = ()
    gained: tuple[str, ...] = ()


def bookkeeping_changes(old: Bookkeeping, new: Bookkeeping) -> tuple[EntryChange, ...]:
    """Return the changes of services, then those of connections, each sorted by name."""
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
    """Yield the facts about ``entry``; the caller compares them with the facts about ``other``."""
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
        # a requester that ``other`` lacks is not repeated here, because it is a fact above
        yield from (f"{what} for {one}" for one in who if what in known and one in other.requesters)


def _topics(entry: _Entry) -> _Requesters:
    inputs = {"topic": entry.topics} if isinstance(entry, ConnectionEntry) else entry.inputs
    return {f"{role} {topic}": who for role, of in inputs.items() for topic, who in of.items()}
