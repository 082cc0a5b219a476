"""Bookkeeping: for each service and connection, who requests it.

This is Table III, column 4, of the paper. It is derived from claims and stored nowhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from demandops.ledger.world import World
from demandops.plan.connection_clients import connection_topics
from demandops.plan.overrides.suspended_claims import suspended_claims, without_suspended
from demandops.plan.release import ServiceRelease
from demandops.plan.views import release_causes
from demandops.subject import SubjectKind


@dataclass(frozen=True, slots=True)
class ServiceEntry:
    """One service: its requesters and its inputs (role → sorted topics)."""

    applications: tuple[str, ...]
    service: str
    node: str
    source: str | None
    source_topic: str | None
    inputs: dict[str, list[str]]
    requesters: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ConnectionEntry:
    """One connection: its requesters and the source topics that it carries."""

    source: str
    target: str
    topics: tuple[str, ...]
    requesters: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SuspendedEntry:
    """A booked claim that is not planned, and the override that suspends it."""

    kind: str
    id: str
    demand: str
    requesters: tuple[str, ...]
    override: str
    reason: str


@dataclass(frozen=True, slots=True)
class Bookkeeping:
    """The whole view: services by release name, connections by id, both sorted.

    ``suspended`` are the claims that an override suspends; they are in neither list.
    """

    services: dict[str, ServiceEntry]
    connections: dict[str, ConnectionEntry]
    suspended: tuple[SuspendedEntry, ...] = ()


def bookkeeping(world: World) -> Bookkeeping:
    """Return the requesters of each service and connection."""
    services = {}
    for release in release_causes.releases(world):
        if isinstance(release, ServiceRelease):
            services[release.name] = ServiceEntry(
                applications=release.applications,
                service=release.key.service,
                node=release.node.id,
                source=release.key.source,
                source_topic=release.key.topic,
                inputs={
                    role: sorted({topic.topic for topic in topics})
                    for role, topics in release.inputs.items()
                },
                requesters=release.requesters,
            )
    connections = {}
    active = without_suspended(world).ledger
    for id in world.ledger.subjects(SubjectKind.CONNECTION):
        claims = active.connection_claims(id)
        if not claims:
            continue
        connections[id] = ConnectionEntry(
            source=claims[0].connection.source,
            target=claims[0].connection.target,
            topics=tuple(route.source for route in connection_topics(claims)),
            requesters=tuple(sorted({who for claim in claims for who in claim.requesters})),
        )
    return Bookkeeping(
        services=dict(sorted(services.items())),
        connections=connections,
        suspended=tuple(_suspended(world)),
    )


def _suspended(world: World) -> Iterator[SuspendedEntry]:
    for claim, override in suspended_claims(world):
        kind = claim.subject.kind.value[:-1]
        yield SuspendedEntry(
            kind,
            claim.subject.id,
            claim.demand,
            claim.requesters,
            override.path,
            override.reason,
        )


def as_data(view: Bookkeeping, commit: str) -> dict[str, Any]:
    """Return the bookkeeping as plain data, the contract of ``bookkeeping --output json``.

    ``suspended`` is left out if it is empty.
    """
    data = asdict(view)
    for entry in data["services"].values():
        entry["applications"] = list(entry["applications"])
        entry["requesters"] = list(entry["requesters"])
    for entry in data["connections"].values():
        entry["topics"] = sorted(entry["topics"])
        entry["requesters"] = list(entry["requesters"])
    suspended = data.pop("suspended")
    if suspended:
        data["suspended"] = [one | {"requesters": list(one["requesters"])} for one in suspended]
    return data | {"commit": commit}
