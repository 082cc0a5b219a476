"""What a demand asks for and holds: applications, leases, claims."""

from __future__ import annotations

import json
from bisect import bisect_left
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timedelta, timezone
from itertools import islice, takewhile
from types import MappingProxyType
from typing import NamedTuple

from demandops.base import naming
from demandops.base.naming import Subject, SubjectKind, TopicKey
from demandops.connections.connection import Connection

# ---- applications ----


class InputTopic(NamedTuple):
    """An input topic of an application, and the node that publishes it."""

    topic: str
    source: str
    type: str = ""
    # It was not the usual topic of its source when it was booked. The claim says so, because a name
    # that is made from it must not change while it is demanded (plan/output_topics.py).
    further: bool = False

    def part_in(self, version: str) -> str:
        return naming.topic_part(self.source, self.distinguishing_text(self.further, version))

    def distinguishing_text(self, further: bool, version: str) -> str:
        if not further:
            return version
        return f"{self.topic} {version}" if version else self.topic


# An output that is brought to a node, as `topic` if that is set
class Delivery(NamedTuple):
    output: str  # `<service>.<output>`
    node: str
    topic: str = ""


@dataclass(frozen=True, slots=True)
class Requirement:
    """Requirements on a node; ``properties`` are texts like ``memoryGiB>=8``."""

    role: str = ""
    labels: tuple[tuple[str, str], ...] = ()
    capabilities: tuple[str, ...] = ()
    properties: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        return len(self.labels) + len(self.capabilities) + len(self.properties)

    def united(self, other: Requirement) -> Requirement:  # two roles must be the same
        return Requirement(
            self.role or other.role,
            tuple(sorted({*self.labels, *other.labels})),
            tuple(sorted({*self.capabilities, *other.capabilities})),
            tuple(sorted({*self.properties, *other.properties})),
        )


@dataclass(frozen=True, slots=True)
class Application:  # noqa: PLW1641 - it contains mappings, so it has no hash
    """One application: its appdef, its node, and its inputs by role."""

    id: str
    # ``#<number>`` if a goal gives the application's type as a number that no appdef has
    appdef: str
    node: str
    inputs: Mapping[str, tuple[InputTopic, ...]]
    parameters: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    version: str = ""
    deliver: tuple[Delivery, ...] = ()
    # the requirements on the node, kept to choose again; None if the demand names the node
    place: Requirement | None = None
    # this version runs beside others, and the id ends in it (demand/separate_instance.py)
    separate: bool = False
    # the nodes of services that have one of their own, by service
    services: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    # the nodes to which an override moves services, by service
    moved: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    # the services whose node the demand itself names; the generator chose the nodes of the others
    named: tuple[str, ...] = ()
    _further: dict[tuple[str, str], list[InputTopic]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Application):
            return NotImplemented
        compared = (field.name for field in fields(self) if field.compare)
        same = all(getattr(self, name) == getattr(other, name) for name in compared)
        # Python treats 1, 1.0 and True as equal, but a chart does not
        return same and _exact(self.parameters) == _exact(other.parameters)

    @property
    def subject(self) -> Subject:
        return Subject(SubjectKind.APPLICATION, self.id)

    @property
    def own_version(self) -> str:  # in the names of services and topics
        return self.version if self.separate else ""

    @property
    def home(self) -> str:
        # its access domain sets leases and quotas
        return self.node

    @property
    def nodes(self) -> tuple[str, ...]:
        return (self.node,)

    def all_inputs(self) -> list[tuple[str, InputTopic]]:
        return [(role, topic) for role, topics in self.inputs.items() for topic in topics]

    def inputs_from(self, role: str, source: str, topic: str) -> tuple[InputTopic, ...]:
        # the inputs must be sorted, as in a claim
        inputs = self.inputs.get(role, ())
        start = bisect_left(inputs, InputTopic(topic, source))
        same = takewhile(
            lambda t: (t.topic, t.source) == (topic, source), islice(inputs, start, None)
        )
        return tuple(same)

    def further_inputs(self, role: str, part: str) -> list[InputTopic]:
        if not self._further:  # computed only once, because the plans of many services need it
            for own_role, topic in self.all_inputs():
                if topic.further or self.separate:
                    key = own_role, topic.part_in(self.own_version)
                    self._further.setdefault(key, []).append(topic)
        return self._further.get((role, part), [])

    def needs(self, node: str) -> bool:
        delivered = any(delivery.node == node for delivery in self.deliver)
        return delivered or node in self.needed_nodes()

    def needed_nodes(self) -> set[str]:
        sources = (topic.source for _, topic in self.all_inputs())
        return {*self.chosen_nodes, *self.moved.values(), *sources}

    def chosen_node(self, service: str) -> str:
        return self.services.get(service, self.node)  # an override may have moved it away

    @property
    def chosen_nodes(self) -> set[str]:
        return {self.node, *self.services.values()}

    def has_same_definition_and_nodes(self, other: Application) -> bool:
        mine, theirs = ((app.appdef, app.node, app.services, app.moved) for app in (self, other))
        return mine == theirs

    def moved_to_nodes_of(self, first: Application) -> Application:
        if (self.node, self.services, self.moved) == (first.node, first.services, first.moved):
            return self
        return replace(self, node=first.node, services=first.services, moved=first.moved)

    def booked(self) -> Application:
        # The order of a goal's lists must not reach the ledger, because the same demand in another
        # order would make a commit.
        inputs: dict[str, tuple[InputTopic, ...]] = {}
        for role, topics in sorted(self.inputs.items()):
            merged: dict[tuple[str, str], InputTopic] = {}
            for topic in topics:
                first = merged.setdefault((topic.topic, topic.source), topic)
                # only some goals give the type of a topic, and the others must not take it away
                if topic.type and not first.type:
                    merged[topic.topic, topic.source] = topic
            inputs[role] = tuple(topic for _, topic in sorted(merged.items()))
        place = self.place and self.place.united(self.place)
        deliver = tuple(sorted({*self.deliver}))
        return replace(self, deliver=deliver, place=place).with_inputs(inputs)

    def with_inputs(self, inputs: Mapping[str, tuple[InputTopic, ...]]) -> Application:
        kept = {role: topics for role, topics in inputs.items() if topics}
        return replace(self, inputs=MappingProxyType(kept))

    def extended(self, more: Application) -> Application:
        roles = {*self.inputs, *more.inputs}
        inputs = {role: (*self.inputs.get(role, ()), *more.inputs.get(role, ())) for role in roles}
        parameters = MappingProxyType({**self.parameters, **more.parameters})
        deliver = (*self.deliver, *more.deliver)
        return replace(
            more, inputs=MappingProxyType(inputs), parameters=parameters, deliver=deliver
        )

    def matches_listed(self, listed: object) -> bool:
        return (
            isinstance(listed, Application)
            and listed.node in ("", self.node)
            and listed.appdef == self.appdef
        )

    def distinguishing_values(self) -> tuple[str, ...]:
        return (self.node, self.appdef)

    def topic_keys(self) -> Iterator[TopicKey]:
        # (role, topic, source) of each input; without inputs one empty key
        for role, topic in self.all_inputs():
            yield role, topic.topic, topic.source
        if not any(self.inputs.values()):
            yield ()

    def listed_topics(self, listed: object) -> Iterator[tuple[str, list[TopicKey]]]:
        """Yield (text, matching keys of this application) for each input that a shutdown lists."""
        assert isinstance(listed, Application)  # noqa: S101 - see matches_listed
        by_name: dict[TopicKey, list[TopicKey]] = {}
        for key in self.topic_keys():
            by_name.setdefault(key[:2], []).append(key)
        for role, topic in listed.all_inputs():
            named = by_name.get((role, topic.topic), [])
            # listed without a source, a topic is that of any source
            keys = [key for key in named if topic.source in ("", key[2])]
            yield f"{role} {topic.topic} of {topic.source}", keys

    def without_topics(self, gone: Container[TopicKey]) -> Application | None:
        left = {
            role: tuple(t for t in topics if (role, t.topic, t.source) not in gone)
            for role, topics in self.inputs.items()
        }
        return self.with_inputs(left) if any(left.values()) else None

    def without_node(self, node: str) -> Application | None:
        if node in self.chosen_nodes or node in self.moved.values():
            return None
        deliver = tuple(delivery for delivery in self.deliver if delivery.node != node)
        left = {
            role: tuple(topic for topic in topics if topic.source != node)
            for role, topics in self.inputs.items()
        }
        return replace(self, deliver=deliver).with_inputs(left) if any(left.values()) else None

    def index_entries(self) -> Iterator[tuple[str, ...]]:
        yield ("node", self.node)
        yield ("definition", self.appdef)
        for node in (*self.services.values(), *self.moved.values()):
            yield ("node", node)
        if self.moved:
            yield ("moved",)
        for role, topic in self.all_inputs():
            yield ("takes", topic.source, topic.topic)
            yield ("from", topic.source)
            yield ("node", topic.source)
            if topic.further or self.separate:
                yield ("further", topic.part_in(self.own_version))
            if not topic.further:
                # with and without the topic, so that the claims with another topic can be counted
                yield ("usual", topic.source, role)
                yield ("usual", topic.source, role, topic.topic)
        if self.version:
            yield ("version", self.id, self.version)
        for delivery in self.deliver:
            yield ("node", delivery.node)
        yield ("topics", naming.topic_part(self.id))


def _exact(values: Mapping[str, object]) -> str:
    return json.dumps(dict(values), sort_keys=True, default=repr) if values else ""


# ---- leases: how long a claim stays booked without a renewal ----
#
# The recorded end may lag behind the last renewal by ``slack``, so that only some renewals make a
# commit. A renewal within the slack changes nothing, and a lease ends only after the recorded end
# and the slack have passed. So no generator, not even a restarted one, releases a claim early, but
# a release may be late by the slack.

LONGEST_S = 366 * 24 * 3600

# The end of a lease that has not started. Its claim awaits approval, or a person approved it and
# the generator has not started the lease yet.
UNSTARTED = datetime(9000, 1, 1, tzinfo=timezone.utc)


@dataclass(frozen=True, slots=True)
class Term:
    seconds: int  # the requested lease
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
        term = Term(self.seconds, self.slack)
        # the approval of a changed demand renews its lease, which never ends earlier than before
        return before.renewed(term, now) if before else term.lease_from(now)

    @property
    def expires_at(self) -> datetime:
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
    subject: Subject
    demand: str


@dataclass(frozen=True, slots=True)
class Claim:
    held: Application | Connection
    demand: str
    request: str
    requesters: tuple[str, ...]
    booked: datetime
    lease: Lease | None = None
    # A goal of the reference's action booked it; a shutdown takes holds only from such claims
    joined: bool = False
    # The topics that only some requesters hold
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
        # the override that made the claim by its effect `keep`
        name = self.demand.removeprefix(OVERRIDE_PREFIX)
        return None if name == self.demand else name

    def index_entries(self) -> Iterator[tuple[str, ...]]:
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
        requesters = tuple(sorted({who for names in holders.values() for who in names}))
        partial = {topic: names for topic, names in holders.items() if names != requesters}
        return replace(self, held=held, requesters=requesters, partial=partial)

    def extending(self, current: Claim) -> Claim:
        # with everything added that the claim so far holds
        held = current.held.extended(self.held).booked()  # type: ignore[arg-type]  # of one kind
        # a shutdown may have taken holds: only what is listed again is held by all requesters
        holders = dict.fromkeys(held.topic_keys(), self.requesters)
        listed = {*self.held.topic_keys()}
        kept = {topic: current.holders(topic) for topic in holders if topic not in listed}
        return self.with_holders(held, holders | kept)

    def without_holds(
        self, requester: str, topics: Container[TopicKey] | None = None
    ) -> Claim | None:
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

    def without_node(self, node: str) -> Claim | None:  # the claim must need the node
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
    # a digest, so that every generator gives a repeated request the same demand id
    exact = json.dumps([request, sorted(set(requesters))], ensure_ascii=True)
    return naming.hash_of(exact, 20)
