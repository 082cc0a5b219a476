"""What is booked, as one value: the ledger, its changes, and the world that it is part of."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from operator import attrgetter
from typing import Literal, TypeAlias

from rpds import HashTrieMap, HashTrieSet

from demandops.base.naming import Subject, SubjectKind
from demandops.connections import connection_types
from demandops.connections.connection import Connection
from demandops.model.config.config import Config
from demandops.model.config.override import Override, format_time
from demandops.model.demand.demand import UNSTARTED, Application, InputTopic
from demandops.model.ledger.claim import Claim, ClaimKey, minute_of
from demandops.model.ledger.records import WaitingDemands

# ---- the ledger: which demand holds which subject, as a set of persistent maps ----
#
# A :class:`Ledger` never changes, because each request makes a new one.

_DEMAND = attrgetter("demand")
_BY_SUBJECT = attrgetter("subject.kind.value", "subject.id", "demand")

Entry: TypeAlias = "tuple[str, ...]"
# The first word of an entry: by what a claim is found. The further words name it.
By = Literal[
    "demand",
    "requester",
    "kept",  # by an override; also with kind and id of its subject
    "ends",  # the minute
    "node",  # of applications that run on, read from or deliver to the node
    "definition",
    "moved",  # applications, by an override
    "takes",  # source and topic of an input
    "reads",  # the application of an output that is an input
    "from",  # the node of which it reads a topic, or carries one
    "usual",  # source and role
    "link",  # type of the connection, and one of its nodes
    "broker",  # the node
    "route",  # the words of a RouteKey
    "brings",  # the node and the topic to which a connection brings it
]
Index: TypeAlias = "HashTrieMap[Entry, HashTrieSet[ClaimKey]]"


@dataclass(frozen=True, slots=True)
class Ledger:
    """All claims, an index of them, and the ledger's other records."""

    # The claims on each subject, sorted by demand id. The generator books only claims that agree
    # about the subject's type and nodes. If a person writes one that disagrees, the first decides.
    # They are a tuple, because the planner asks for all of them at each join, and a persistent map
    # would make and sort them anew each time.
    claims: HashTrieMap[Subject, tuple[Claim, ...]] = field(default_factory=HashTrieMap)
    # The keys of the claims that have an entry. What a request costs then depends on its claims and
    # not on all claims.
    index: Index = field(default_factory=HashTrieMap)
    # each minute in which a lease and its slack end: the next end is found without a scan of claims
    minutes: HashTrieSet[str] = field(default_factory=HashTrieSet)
    # the end that each ended override had when it ended, by name
    ended: Mapping[str, str] = field(default_factory=dict)
    # For how many applications each node was chosen, also if only for one of their services. The
    # choice of nodes takes the emptiest, and must not count all claims for each demand.
    applications_on: HashTrieMap[str, int] = field(default_factory=HashTrieMap)
    waiting: WaitingDemands = field(default_factory=HashTrieMap)

    def claims_on(self, subject: Subject) -> tuple[Claim, ...]:
        return self.claims.get(subject) or ()

    # the one with the lowest demand id
    def first_claim(self, subject: Subject) -> Claim | None:
        held = self.claims.get(subject)
        return held[0] if held else None

    def application_claims(self, application: str) -> tuple[Claim, ...]:
        return self.claims_on(Subject(SubjectKind.APPLICATION, application))

    def connection_claims(self, connection: str) -> tuple[Claim, ...]:
        return self.claims_on(Subject(SubjectKind.CONNECTION, connection))

    def application(self, id: str) -> Application | None:
        first = self.first_claim(Subject(SubjectKind.APPLICATION, id))
        return first.application if first else None

    def connection(self, id: str) -> Connection | None:
        first = self.first_claim(Subject(SubjectKind.CONNECTION, id))
        return first.connection if first else None

    def versions_asked(self, application: str, known: Container[str]) -> set[str]:
        # an empty text stands for claims that ask for no version, or for an unknown one
        asked = {claim.application.version for claim in self.application_claims(application)}
        return {word if word in known else "" for word in asked}

    def keys_with(self, by: By, *words: str) -> Collection[ClaimKey]:
        return self.index.get((by, *words)) or ()

    def ids_with(self, by: By, *words: str) -> tuple[str, ...]:
        return tuple(sorted({key.subject.id for key in self.keys_with(by, *words)}))

    def each_with(self, by: By, *words: str) -> Iterator[Claim]:
        # in no order, without the cost of sorting
        return (claim for key in self.keys_with(by, *words) if (claim := self.get(key)))

    def claims_with(self, by: By, *words: str) -> tuple[Claim, ...]:
        keys = sorted(self.keys_with(by, *words), key=_BY_SUBJECT)
        return tuple(claim for key in keys if (claim := self.get(key)))

    def claims_needing(self, node: str) -> tuple[Claim, ...]:
        keys = {*self.keys_with("node", node), *self.keys_with("broker", node)}
        for kind in connection_types.CONNECTION_TYPES:
            keys |= {*self.keys_with("link", kind.name, node)}
        return tuple(c for key in sorted(keys, key=_BY_SUBJECT) if (c := self.get(key)))

    def subjects(self, kind: SubjectKind) -> list[str]:
        return sorted(subject.id for subject in self.claims if subject.kind is kind)

    def booked_input(self, role: str, source: str, topic: str) -> InputTopic | None:
        for claim in self.each_with("takes", source, topic):
            if inputs := claim.application.inputs_from(role, source, topic):
                return inputs[0]
        return None

    def kept_claims(self, subject: Subject | None = None) -> tuple[Claim, ...]:
        return self.claims_with("kept", *([subject.kind.value, subject.id] if subject else []))

    def next_lease_end(self) -> datetime | None:
        # of the lease with its slack; `UNSTARTED` if none started
        claims = self.each_with("ends", min(self.minutes)) if self.minutes else ()
        return min((claim.lease.expires_at for claim in claims if claim.lease), default=None)

    def first_to_end(self) -> HashTrieSet[ClaimKey] | None:
        # those that end in the earliest minute: the same object until a claim enters the set,
        # leaves it or gets another lease
        return self.index.get(("ends", min(self.minutes))) if self.minutes else None

    def unstarted_claims(self) -> tuple[Claim, ...]:
        later = (minute for minute in self.minutes if minute >= minute_of(UNSTARTED))
        claims = (claim for minute in sorted(later) for claim in self.claims_with("ends", minute))
        return tuple(claim for claim in claims if claim.lease and not claim.lease.has_started)

    def ended_claims(self, now: datetime) -> tuple[Claim, ...]:
        # the earliest end first
        over = (minute for minute in self.minutes if minute <= minute_of(now))
        ended = [
            (claim.lease.expires_at, claim)
            for minute in over
            for claim in self.claims_with("ends", minute)
            if claim.lease and claim.lease.has_ended(now)
        ]
        return tuple(claim for _, claim in sorted(ended, key=lambda pair: pair[0]))

    def indexed_names(self, entry: str) -> set[str]:
        # the last text of each entry; this scans the index
        return {key[-1] for key in self.index if key[0] == entry}

    def get(self, key: ClaimKey) -> Claim | None:
        held = self.claims_on(key.subject)
        place = bisect_left(held, key.demand, key=_DEMAND)
        return held[place] if place < len(held) and held[place].demand == key.demand else None

    def replace(self, key: ClaimKey, claim: Claim | None) -> Ledger:
        held, old = self.claims_on(key.subject), self.get(key)
        if old == claim:
            return self
        place = bisect_left(held, key.demand, key=_DEMAND)
        held = held[:place] + ((claim,) if claim else ()) + held[place + (old is not None) :]
        claims = self.claims.insert(key.subject, held) if held else self.claims.remove(key.subject)
        before, after = ({*each.index_entries()} if each else set[Entry]() for each in (old, claim))
        index, minutes = self.index, self.minutes
        for entry in before - after:
            others = index[entry].remove(key)
            index = index.insert(entry, others) if others else index.remove(entry)
            if not others and entry[0] == "ends":
                minutes = minutes.remove(entry[1])
        added = after - before
        if old and claim and old.lease != claim.lease:
            # so that first_to_end returns a new object, by which the expiry sees the change
            added |= {entry for entry in after if entry[0] == "ends"}
        for entry in added:
            index = index.insert(entry, index.get(entry, HashTrieSet()).insert(key))
            if entry[0] == "ends":
                minutes = minutes.insert(entry[1])
        counts = self.applications_on
        if key.subject.kind is SubjectKind.APPLICATION:
            # of all claims on the application, the first decides where it runs
            firsts = (self.first_claim(key.subject), held[0] if held else None)
            nodes = [first.application.chosen_nodes if first else set[str]() for first in firsts]
            for ids, change in ((nodes[0] - nodes[1], -1), (nodes[1] - nodes[0], 1)):
                for id in ids:
                    count = (counts.get(id) or 0) + change
                    counts = counts.insert(id, count) if count else counts.remove(id)
        return replace(self, claims=claims, index=index, minutes=minutes, applications_on=counts)

    def without(self, claims: Iterable[Claim]) -> Ledger:
        ledger = self
        for claim in claims:
            ledger = ledger.replace(claim.key, None)
        return ledger

    def without_waiting(self, demands: Iterable[str]) -> Ledger:
        waiting = self.waiting
        for demand in demands:
            waiting = waiting.discard(demand)
        return replace(self, waiting=waiting)

    def __iter__(self) -> Iterator[Claim]:
        for claims in self.claims.values():
            yield from claims


def ledger_of(claims: Iterable[Claim]) -> Ledger:
    ledger = Ledger()
    for claim in claims:
        ledger = ledger.replace(claim.key, claim)
    return ledger


# ---- what a request changes in the ledger: claims, and other records ----


@dataclass(frozen=True, slots=True)
class ClaimChange:
    before: Claim | None  # None: the claim is new
    after: Claim | None  # None: it is released

    @property
    def key(self) -> ClaimKey:
        claim = self.after or self.before
        assert claim is not None  # noqa: S101 - a change has at least one side
        return claim.key

    @property
    def only_renews(self) -> bool:
        # at most the lease changed
        before, after = self.before, self.after
        return bool(before and after and replace(after, lease=before.lease) == before)

    @property
    def only_narrows(self) -> bool:
        # at most topics are given up, and the lease changed
        before, after = self.before, self.after
        if before is None or after is None:
            return after is None
        left = before.without_topics({*before.held.topic_keys()} - {*after.held.topic_keys()})
        return left is not None and left == replace(
            after, lease=left.lease, booked=left.booked, request=left.request
        )


@dataclass(frozen=True, slots=True)
class Changes:
    claims: tuple[ClaimChange, ...] = ()
    # in words, what a shutdown lists, but its claim does not hold
    not_held: tuple[str, ...] = ()
    # the ids of the demands that begin or cease to wait, or that now wait with another goal
    waiting: tuple[str, ...] = ()

    def subjects(self) -> tuple[Subject, ...]:
        return tuple(dict.fromkeys(change.key.subject for change in self.claims))


def changes_on(
    before: Ledger, after: Ledger, subjects: Iterable[Subject]
) -> tuple[ClaimChange, ...]:
    keys = (
        claim.key
        for subject in subjects
        for ledger in (before, after)
        for claim in ledger.claims_on(subject)
    )
    return claim_changes(before, after, keys)


def claim_changes(
    before: Ledger, after: Ledger, keys: Iterable[ClaimKey]
) -> tuple[ClaimChange, ...]:
    changes = (ClaimChange(before.get(key), after.get(key)) for key in dict.fromkeys(keys))
    return tuple(change for change in changes if change.before != change.after)


# ---- the world: the configuration and the ledger in effect ----


@dataclass(frozen=True, slots=True)
class World:
    config: Config
    ledger: Ledger
    # the overrides that have not ended, in the order in which they apply
    overrides: tuple[Override, ...] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        active = [
            override
            for name, override in self.config.overrides.items()
            # a person who extends an ended override gives it a new end, and so it is active again
            if override.end is None or self.ledger.ended.get(name) != format_time(override.end)
        ]
        # the last one wins
        by_rank = sorted(active, key=lambda override: (override.priority, override.name))
        object.__setattr__(self, "overrides", tuple(by_rank))

    def nodes_to_drain(self) -> list[str]:
        """Return the drained nodes with applications or services that were placed there."""
        used, config = self.ledger.applications_on, self.config
        drained: Iterable[str] = config.drained_nodes
        if config.drains_patterns:  # their nodes are known only by their use
            drained = (id for id in used if (node := config.nodes.get(id)) and node.drained)
        return sorted(id for id in drained if id in used)
