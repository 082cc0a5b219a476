"""The books: which demand holds which subject, as a set of persistent maps.

A :class:`Ledger` never changes: a new one costs what a request touches and not what is booked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import TypeAlias

from rpds import HashTrieMap, HashTrieSet

from demandops.demand.claim import (
    ApplicationClaim,
    Claim,
    ClaimKey,
    ConnectionClaim,
    Subject,
    SubjectKind,
)
from demandops.demand.demand_request import ConnectionType
from demandops.demand.lease import UNSTARTED

Claims: TypeAlias = "HashTrieMap[str, Claim]"
"""The claims of one subject by demand id."""


@dataclass(frozen=True, slots=True)
class ClaimChange:
    """One claim before and after; nothing before it was booked, nothing after it was released."""

    before: Claim | None
    after: Claim | None

    @property
    def key(self) -> ClaimKey:
        """Which claim it is."""
        claim = self.after or self.before
        assert claim is not None  # noqa: S101 - a change has at least one side
        return claim.key


@dataclass(frozen=True, slots=True)
class Changes:
    """What a request did: the claims that changed and what of a shutdown was not held."""

    claims: tuple[ClaimChange, ...] = ()
    not_held: tuple[str, ...] = ()

    def subjects(self) -> tuple[Subject, ...]:
        """Return the subjects whose claims changed, each once."""
        return tuple(dict.fromkeys(change.key.subject for change in self.claims))


_ENDS = "ends"

Entry: TypeAlias = "tuple[str, ...]"
Index: TypeAlias = "HashTrieMap[Entry, HashTrieSet[ClaimKey]]"


@dataclass(frozen=True, slots=True)
class Ledger:
    """All claims, with an index for each question that a request asks.

    ``index`` maps what :func:`entries` says of a claim to the claims of which it holds.
    ``minutes`` are those in which some lease ends: the next end is found without looking at all.
    """

    claims: HashTrieMap[Subject, Claims] = field(default_factory=HashTrieMap)
    index: Index = field(default_factory=HashTrieMap)
    minutes: HashTrieSet[str] = field(default_factory=HashTrieSet)

    def of(self, subject: Subject) -> tuple[Claim, ...]:
        """Return the claims on ``subject``, sorted by demand id."""
        held = self.claims.get(subject)
        return tuple(held[demand] for demand in sorted(held)) if held else ()

    def application(self, application: str) -> tuple[ApplicationClaim, ...]:
        """Return the claims on an application."""
        claims = self.of(Subject(SubjectKind.APPLICATION, application))
        return tuple(claim for claim in claims if isinstance(claim, ApplicationClaim))

    def connection(self, connection: str) -> tuple[ConnectionClaim, ...]:
        """Return the claims on a connection."""
        claims = self.of(Subject(SubjectKind.CONNECTION, connection))
        return tuple(claim for claim in claims if isinstance(claim, ConnectionClaim))

    def type_of(self, connection: str) -> ConnectionType | None:
        """Return the type of a connection that something holds, or nothing."""
        claims = self.connection(connection)
        return claims[0].type if claims else None

    def subjects(self, kind: SubjectKind) -> list[str]:
        """Return the ids of all subjects of a kind that something holds, sorted."""
        return sorted(subject.id for subject in self.claims if subject.kind is kind)

    def taking(self, source: str, topic: str) -> tuple[str, ...]:
        """Return the applications that take ``topic`` of ``source`` in, sorted."""
        return self._ids("takes", source, topic)

    def bringing(self, target: str, topic: str) -> tuple[str, ...]:
        """Return the connections that bring ``topic`` to the node ``target``, sorted."""
        return self._ids("brings", target, topic)

    def carries(self, target: str, topic: str) -> bool:
        """Tell whether some connection brings ``topic`` to the node ``target``."""
        return ("brings", target, topic) in self.index

    def of_demand(self, demand: str) -> tuple[Claim, ...]:
        """Return the claims of one demand, sorted by subject."""
        return self._claims("demand", demand)

    def of_requester(self, requester: str) -> tuple[Claim, ...]:
        """Return the claims in a requester's name, sorted by subject and demand."""
        return self._claims("requester", requester)

    def at_node(self, node: str) -> tuple[str, ...]:
        """Return the applications that run on a node or take a topic of it in, sorted."""
        return self._ids("node", node)

    def next_end(self) -> datetime | None:
        """Return when the first lease ends, or nothing where there is none."""
        if not self.minutes:
            return None
        first = self._claims(_ENDS, min(self.minutes))
        return min(claim.lease.expires_at for claim in first if claim.lease)

    def unstarted(self) -> tuple[Claim, ...]:
        """Return the claims whose lease has not begun: approved, and not yet taken in."""
        later = (minute for minute in self.minutes if minute >= _minute(UNSTARTED))
        found = (claim for minute in sorted(later) for claim in self._claims(_ENDS, minute))
        return tuple(claim for claim in found if claim.lease and not claim.lease.has_started)

    def ended(self, now: datetime) -> tuple[Claim, ...]:
        """Return the claims whose lease ended before ``now``, the first to end first."""
        over = (minute for minute in self.minutes if minute <= _minute(now))
        ended = [
            (claim.lease.expires_at, claim)
            for minute in over
            for claim in self._claims(_ENDS, minute)
            if claim.lease and claim.lease.expires_at < now
        ]
        return tuple(claim for _, claim in sorted(ended, key=lambda pair: pair[0]))

    def _ids(self, *entry: str) -> tuple[str, ...]:
        return tuple(sorted({key.subject.id for key in self.index.get(entry) or ()}))

    def _claims(self, *entry: str) -> tuple[Claim, ...]:
        keys = sorted(self.index.get(entry) or (), key=lambda key: (str(key.subject), key.demand))
        found = (self.get(key) for key in keys)
        return tuple(claim for claim in found if claim is not None)

    def at(self, kind: ConnectionType, node: str) -> tuple[str, ...]:
        """Return the connections of a type that end at ``node``, sorted."""
        return self._ids("link", kind.name, node)

    def connected(self, node: str) -> tuple[str, ...]:
        """Return the connections that end at a node or go by a broker that was asked for there."""
        found = {id for kind in ConnectionType for id in self.at(kind, node)}
        return tuple(sorted(found | set(self._ids("broker", node))))

    def names(self, entry: str) -> set[str]:
        """Return what the index has of one kind, the requesters say; costs as much as there is."""
        return {known[-1] for known in self.index if known[0] == entry}

    def get(self, key: ClaimKey) -> Claim | None:
        """Return one claim."""
        held = self.claims.get(key.subject)
        return held.get(key.demand) if held else None

    def replace(self, key: ClaimKey, claim: Claim | None) -> Ledger:
        """Return the ledger with the claim at ``key`` set, or gone where ``claim`` is nothing."""
        held = self.claims.get(key.subject, HashTrieMap())
        old = held.get(key.demand)
        if old == claim:
            return self
        held = held.insert(key.demand, claim) if claim else held.remove(key.demand)
        claims = self.claims.insert(key.subject, held) if held else self.claims.remove(key.subject)
        before, after = entries(old), entries(claim)
        index, minutes = self.index, self.minutes
        for entry in before - after:
            rest = index[entry].remove(key)
            index = index.insert(entry, rest) if rest else index.remove(entry)
            if not rest and entry[0] == _ENDS:
                minutes = minutes.remove(entry[1])
        for entry in after - before:
            index = index.insert(entry, index.get(entry, HashTrieSet()).insert(key))
            if entry[0] == _ENDS:
                minutes = minutes.insert(entry[1])
        return Ledger(claims, index, minutes)

    def restored(self, subject: Subject, other: Ledger) -> Ledger:
        """Return the ledger with the claims on ``subject`` as they are in ``other``."""
        ledger = self
        for claim in self.of(subject):
            ledger = ledger.replace(claim.key, None)
        for claim in other.of(subject):
            ledger = ledger.replace(claim.key, claim)
        return ledger

    def __iter__(self) -> Iterator[Claim]:
        """Yield every claim, in no order."""
        for claims in self.claims.values():
            yield from claims.values()

    def __len__(self) -> int:
        """Return how many claims there are."""
        return sum(len(claims) for claims in self.claims.values())


def entries(claim: Claim | None) -> set[Entry]:
    """Return what a claim is found by."""
    if claim is None:
        return set()
    found: set[Entry] = {("demand", claim.demand)}
    found |= {("requester", requester) for requester in claim.requesters}
    if claim.lease is not None:
        found.add((_ENDS, _minute(claim.lease.expires_at)))
    if isinstance(claim, ApplicationClaim):
        found.add(("node", claim.node))
        for _, topic in claim.all_inputs():
            found |= {("takes", topic.source, topic.topic), ("node", topic.source)}
    else:
        for end in (claim.source, claim.target):
            found.add(("link", claim.type.name, end))
        if claim.broker:
            found.add(("broker", claim.broker))
        for route in claim.topics.values():
            _, taking = route.sender_and_receiver(claim.source, claim.target)
            found.add(("brings", taking, route.written_topic))
    return found


def _minute(moment: datetime) -> str:
    """Return the minute of a moment, in UTC and so that texts sort as times do."""
    return moment.astimezone(timezone.utc).strftime("%Y-%m-%dT%H:%M")


def differences(before: Ledger, after: Ledger, keys: Iterable[ClaimKey]) -> tuple[ClaimChange, ...]:
    """Return the claims at ``keys`` that are not the same in both ledgers."""
    changes = (ClaimChange(before.get(key), after.get(key)) for key in dict.fromkeys(keys))
    return tuple(change for change in changes if change.before != change.after)
