"""Claims: one demand's hold on one subject. The ledger stores claims only."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.connections.connection import Connection
from demandops.demand.application import Application
from demandops.demand.lease import Lease
from demandops.subject import Subject, SubjectKind

OVERRIDE_PREFIX = "override:"
"""The prefix of the demand ids of claims that overrides make; no other demand may use it."""


@dataclass(frozen=True, slots=True)
class ClaimKey:
    """The identity of a claim; each is one file of the ledger."""

    subject: Subject
    demand: str


@dataclass(frozen=True, slots=True)
class Claim:
    """One demand's hold on an application or a connection."""

    held: Application | Connection
    demand: str
    request: str
    requesters: tuple[str, ...]
    booked: datetime
    lease: Lease | None = None

    @property
    def application(self) -> Application:
        """The held application; only for a claim on an application."""
        assert isinstance(self.held, Application), self.subject  # noqa: S101
        return self.held

    @property
    def connection(self) -> Connection:
        """The held connection; only for a claim on a connection."""
        assert isinstance(self.held, Connection), self.subject  # noqa: S101
        return self.held

    @property
    def subject(self) -> Subject:
        """The subject that it holds."""
        return self.held.subject

    @property
    def is_on_application(self) -> bool:
        """Whether it holds an application."""
        return self.subject.kind is SubjectKind.APPLICATION

    @property
    def key(self) -> ClaimKey:
        """The key of the claim in the ledger."""
        return ClaimKey(self.subject, self.demand)

    @property
    def keeping_override(self) -> str | None:
        """The name of the override whose effect ``keep`` made the claim, or ``None``."""
        name = self.demand.removeprefix(OVERRIDE_PREFIX)
        return None if name == self.demand else name

    def index_entries(self) -> Iterator[tuple[str, ...]]:
        """Yield the entries by which the ledger's index finds it, except the end of its lease."""
        yield ("demand", self.demand)
        for requester in self.requesters:
            yield ("requester", requester)
        if self.keeping_override is not None:
            yield ("kept",)
            yield ("kept", self.subject.kind.value, self.subject.id)
        yield from self.held.index_entries()

    def after_booking(self, current: Claim | None) -> Claim:
        """Return it with the booking time of the ``current`` claim if at most the lease differs."""
        if current is None:
            return self
        kept = replace(self, booked=current.booked)
        return kept if replace(kept, lease=current.lease) == current else self


def requesters_of(claims: Iterable[Claim]) -> tuple[str, ...]:
    """Return the requesters of claims, sorted."""
    return tuple(sorted({who for claim in claims for who in claim.requesters}))


def demand_id(request: str, requesters: Iterable[str]) -> str:
    """Return a demand id for a request of the reference's action, which has none.

    It is a digest of the request id and the set of requesters, so a repeated request is the same
    demand.
    """
    exact = json.dumps([request, sorted(set(requesters))], ensure_ascii=True)
    return hashlib.sha256(exact.encode()).hexdigest()[:20]
