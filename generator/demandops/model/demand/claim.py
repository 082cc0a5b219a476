"""Leases: how long a claim stays booked without a renewal.

The recorded end may lag behind the last renewal by ``slack``, so that only some renewals make a
commit. A renewal within the slack changes nothing, and a lease ends only after the recorded end and
the slack have passed. So no generator, not even a restarted one, releases a claim early,
but a release may be late by the slack.
"""

from __future__ import annotations

import json
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta, timezone

from demandops.base import naming
from demandops.base.naming import Subject, SubjectKind, TopicKey
from demandops.connections.connection import Connection
from demandops.model.demand.application import Application

LONGEST_S = 366 * 24 * 3600

# The end of a lease that has not started. Its claim awaits approval, or a person approved it and
# the generator has not started the lease yet.
UNSTARTED = datetime(9000, 1, 1, tzinfo=timezone.utc)


@dataclass(frozen=True, slots=True)
class Term:
    """The requested lease and its slack, both in seconds."""

    seconds: int
    slack: int = 0
    # the lease starts when a person approves the request, not when the request is received
    on_approval: bool = False

    def lease_from(self, now: datetime) -> Lease:
        if self.on_approval:
            return Lease(self.seconds, self.slack, UNSTARTED)
        return Lease(self.seconds, self.slack, now + timedelta(seconds=self.seconds))


@dataclass(frozen=True, slots=True)
class Lease:
    seconds: int
    slack: int
    until: datetime

    @property
    def has_started(self) -> bool:
        return self.until < UNSTARTED

    def started(self, now: datetime, before: Lease | None = None) -> Lease:
        """Return the lease of a claim that a person approves at ``now``."""
        term = Term(self.seconds, self.slack)
        # the approval of a changed demand renews its lease, which never ends earlier than before
        return before.renewed(term, now) if before else term.lease_from(now)

    @property
    def expires_at(self) -> datetime:
        """The time after which the claim may be released."""
        return self.until + timedelta(seconds=self.slack)

    def has_ended(self, now: datetime) -> bool:
        return self.expires_at < now

    def renewed(self, term: Term, now: datetime) -> Lease:
        wanted = term.lease_from(now)
        same_term = (self.seconds, self.slack) == (term.seconds, term.slack)
        # a thousand vehicles renew every few minutes, and not each renewal may make a commit
        if same_term and wanted.until <= self.expires_at:
            return self
        # the end never moves to an earlier time, because the clock may have been set back
        return replace(wanted, until=max(wanted.until, self.until))


def renewed(current: Lease | None, term: Term | None, now: datetime) -> Lease | None:
    if term is None:
        return None
    return current.renewed(term, now) if current else term.lease_from(now)


# ---- claims: one demand's hold on one subject ----

# The prefix of the demand ids of claims that overrides make; no other demand may use it
OVERRIDE_PREFIX = "override:"


@dataclass(frozen=True, slots=True)
class ClaimKey:
    """The identity of a claim; the ledger has one file for each claim."""

    subject: Subject
    demand: str


@dataclass(frozen=True, slots=True)
class Claim:
    """One demand's hold on an application or a connection.

    ``joined``: a goal of the reference's action booked the claim; a shutdown takes holds only from
    such claims. ``partial`` maps each topic that only some ``requesters`` hold to these.
    """

    held: Application | Connection
    demand: str
    request: str
    requesters: tuple[str, ...]
    booked: datetime
    lease: Lease | None = None
    joined: bool = False
    partial: Mapping[TopicKey, tuple[str, ...]] = field(default_factory=dict)

    @property
    def application(self) -> Application:
        assert isinstance(self.held, Application), self.subject  # noqa: S101
        return self.held

    @property
    def connection(self) -> Connection:
        assert isinstance(self.held, Connection), self.subject  # noqa: S101
        return self.held

    @property
    def subject(self) -> Subject:
        return self.held.subject

    @property
    def is_on_application(self) -> bool:
        return self.subject.kind is SubjectKind.APPLICATION

    @property
    def key(self) -> ClaimKey:
        return ClaimKey(self.subject, self.demand)

    @property
    def keeping_override(self) -> str | None:
        """The name of the override that made the claim by its effect ``keep``."""
        name = self.demand.removeprefix(OVERRIDE_PREFIX)
        return None if name == self.demand else name

    def index_entries(self) -> Iterator[tuple[str, ...]]:
        """Yield the claim's entries in the ledger's index, except the end of its lease."""
        yield ("demand", self.demand)
        for requester in self.requesters:
            yield ("requester", requester)
            yield ("holder", requester, self.subject.kind.value, self.subject.id)
        if self.keeping_override is not None:
            yield ("kept",)
            yield ("kept", self.subject.kind.value, self.subject.id)
        yield from self.held.index_entries()

    def holders(self, topic: TopicKey) -> tuple[str, ...]:
        return self.partial.get(topic, self.requesters)

    def with_holders(
        self, held: Application | Connection, holders: Mapping[TopicKey, tuple[str, ...]]
    ) -> Claim:
        """Return the claim with other content; ``holders`` maps each topic to sorted requesters."""
        requesters = tuple(sorted({who for names in holders.values() for who in names}))
        partial = {topic: names for topic, names in holders.items() if names != requesters}
        return replace(self, held=held, requesters=requesters, partial=partial)

    def extending(self, current: Claim) -> Claim:
        """Return the claim with everything added that ``current``, the claim so far, holds."""
        held = current.held.extended(self.held).booked()  # type: ignore[arg-type]  # of one kind
        # a shutdown may have taken holds: only what is listed again is held by all requesters
        holders = dict.fromkeys(held.topic_keys(), self.requesters)
        listed = {*self.held.topic_keys()}
        kept = {topic: current.holders(topic) for topic in holders if topic not in listed}
        return self.with_holders(held, holders | kept)

    def without_holds(
        self, requester: str, topics: Container[TopicKey] | None = None
    ) -> Claim | None:
        """Return the claim without a requester's holds on ``topics``, or on all topics."""
        holders, gone = dict[TopicKey, tuple[str, ...]](), set[TopicKey]()
        for topic in self.held.topic_keys():
            names = self.holders(topic)
            if topics is None or topic in topics:
                names = tuple(who for who in names if who != requester)
            if names:
                holders[topic] = names
            else:  # nobody holds the topic any longer, so the claim loses it
                gone.add(topic)
        held = self.held.without_topics(gone) if gone else self.held
        return None if held is None else self.with_holders(held, holders)

    def without_node(self, node: str) -> Claim | None:
        """Return what is left of the claim, which must need the node, without it."""
        held = self.held.without_node(node)
        if held is None:
            return None
        return self.with_holders(held, {t: self.holders(t) for t in held.topic_keys()})

    def after_booking(self, current: Claim | None) -> Claim:
        if current is None:
            return self
        # The time of booking stays if at most the lease changes. Else each renewal, and each demand
        # that is sent again, would change the claim's file.
        kept = replace(self, booked=current.booked)
        return kept if replace(kept, lease=current.lease) == current else self


def requesters_of(claims: Iterable[Claim]) -> tuple[str, ...]:
    return tuple(sorted({who for claim in claims for who in claim.requesters}))


def demand_id(request: str, requesters: Iterable[str]) -> str:
    """Return the demand id for a request of the reference's action, which names no demand."""
    # a digest, so that every generator gives a repeated request the same demand id
    exact = json.dumps([request, sorted(set(requesters))], ensure_ascii=True)
    return naming.hash_of(exact, 20)
