"""Claims: one demand's hold on one subject. The ledger stores claims only."""

from __future__ import annotations

import hashlib
import json
from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from datetime import datetime
from enum import Enum
from itertools import islice, takewhile
from types import MappingProxyType

from demandops.connections.connection_type import ConnectionType
from demandops.connections.route import Route
from demandops.demand.demand_request import OVERRIDE_PREFIX, InputTopic
from demandops.demand.lease import Lease


class SubjectKind(Enum):
    """The kinds of subjects; the values are the ledger's folder names."""

    APPLICATION = "applications"
    CONNECTION = "connections"


@dataclass(frozen=True, slots=True)
class Subject:
    """An application or a connection, by its exact id."""

    kind: SubjectKind
    id: str

    def __str__(self) -> str:
        """Return ``application 'edge/fusion'``."""
        return f"{self.kind.value[:-1]} '{self.id}'"


@dataclass(frozen=True, slots=True)
class ClaimKey:
    """The identity of a claim; each is one file of the ledger."""

    subject: Subject
    demand: str


@dataclass(frozen=True, slots=True)
class ApplicationClaim:  # noqa: PLW1641 - claims contain mappings, so they have no hash
    """One demand's hold on an application. ``inputs`` are sorted by topic within each role."""

    application: str
    demand: str
    request: str
    requesters: tuple[str, ...]
    booked: datetime
    appdef: str
    node: str
    inputs: Mapping[str, tuple[InputTopic, ...]]
    parameters: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    version: str = ""
    lease: Lease | None = None

    def __eq__(self, other: object) -> bool:
        """Compare exactly: in Python 1 equals True and 1.0, but a chart treats them differently."""
        if not isinstance(other, ApplicationClaim):
            return NotImplemented
        same = all(getattr(self, one.name) == getattr(other, one.name) for one in fields(self))
        return same and _exact(self.parameters) == _exact(other.parameters)

    @property
    def subject(self) -> Subject:
        """The claimed application."""
        return Subject(SubjectKind.APPLICATION, self.application)

    @property
    def key(self) -> ClaimKey:
        """The key of the claim in the ledger."""
        return ClaimKey(self.subject, self.demand)

    def all_inputs(self) -> Iterable[tuple[str, InputTopic]]:
        """Return every (role, topic)."""
        return [(role, topic) for role, topics in self.inputs.items() for topic in topics]

    def inputs_from(self, role: str, source: str, topic: str) -> tuple[InputTopic, ...]:
        """Return the inputs in a role that are ``topic`` of ``source``; they differ by type."""
        inputs = self.inputs.get(role, ())
        start = bisect_left(inputs, InputTopic(topic, source))
        same = takewhile(
            lambda one: (one.topic, one.source) == (topic, source), islice(inputs, start, None)
        )
        return tuple(same)


def _exact(values: Mapping[str, object]) -> str:
    return json.dumps(dict(values), sort_keys=True, default=repr) if values else ""


@dataclass(frozen=True, slots=True)
class ConnectionClaim:
    """One demand's hold on a connection. ``topics`` are routes by source topic, sorted."""

    connection: str
    demand: str
    request: str
    requesters: tuple[str, ...]
    booked: datetime
    type: ConnectionType
    source: str
    target: str
    broker: str
    topics: Mapping[str, Route]
    lease: Lease | None = None

    @property
    def subject(self) -> Subject:
        """The claimed connection."""
        return Subject(SubjectKind.CONNECTION, self.connection)

    @property
    def key(self) -> ClaimKey:
        """The key of the claim in the ledger."""
        return ClaimKey(self.subject, self.demand)


Claim = ApplicationClaim | ConnectionClaim


def is_override_claim(claim: Claim) -> bool:
    """Return whether an override with the effect ``keep`` made the claim."""
    return claim.demand.startswith(OVERRIDE_PREFIX)


def demand_id(request: str, requesters: Iterable[str]) -> str:
    """Return a demand id for a request of the reference's action, which has none.

    It is a digest of the request id and the set of requesters, so a repeated request is the same
    demand.
    """
    exact = json.dumps([request, sorted(set(requesters))], ensure_ascii=True)
    return hashlib.sha256(exact.encode()).hexdigest()[:20]
