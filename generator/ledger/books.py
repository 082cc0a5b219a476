"""The books: which demand holds which subject, as a set of persistent maps.

A :class:`Ledger` never changes: a new one costs what a request touches and not what is booked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from rpds import HashTrieMap, HashTrieSet

from generator.demand.claim import (
    ApplicationClaim,
    Claim,
    ClaimKey,
    ConnectionClaim,
    Subject,
    SubjectKind,
)
from generator.demand.request import ConnectionType

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


@dataclass(frozen=True, slots=True)
class Ledger:
    """All claims, with the look-ups that planning needs.

    ``takers``: (source node, topic) → applications that take that topic in.
    ``carriers``: (node, topic) → connections that bring it there.
    ``links``: (connection type, node) → connections that end there; not for MQTT, whose clients
    know nothing of each other.
    """

    claims: HashTrieMap[Subject, Claims] = field(default_factory=HashTrieMap)
    takers: HashTrieMap[tuple[str, str], HashTrieSet[str]] = field(default_factory=HashTrieMap)
    carriers: HashTrieMap[tuple[str, str], HashTrieSet[str]] = field(default_factory=HashTrieMap)
    links: HashTrieMap[tuple[str, str], HashTrieSet[str]] = field(default_factory=HashTrieMap)

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
        return tuple(sorted(self.takers.get((source, topic)) or ()))

    def carries(self, target: str, topic: str) -> bool:
        """Tell whether some connection brings ``topic`` to the node ``target``."""
        return (target, topic) in self.carriers

    def at(self, kind: ConnectionType, node: str) -> tuple[str, ...]:
        """Return the connections of a type that end at ``node``, sorted; not kept for MQTT."""
        return tuple(sorted(self.links.get((kind.name, node)) or ()))

    def get(self, key: ClaimKey) -> Claim | None:
        """Return one claim."""
        held = self.claims.get(key.subject)
        return held.get(key.demand) if held else None

    def replace(self, key: ClaimKey, claim: Claim | None) -> Ledger:
        """Return the ledger with the claim at ``key`` set, or gone where ``claim`` is nothing."""
        before = self.claims.get(key.subject, HashTrieMap())
        if claim is None:
            if key.demand not in before:
                return self
            after = before.remove(key.demand)
        else:
            after = before.insert(key.demand, claim)
        claims = (
            self.claims.insert(key.subject, after) if after else self.claims.remove(key.subject)
        )
        old = before.get(key.demand)
        if key.subject.kind is SubjectKind.APPLICATION:
            takers = _reindex(
                self.takers, key.subject.id, _taken([old]), _taken(after.values()), _taken([claim])
            )
            return replace(self, claims=claims, takers=takers)
        carriers, links = (
            _reindex(index, key.subject.id, of([old]), of(after.values()), of([claim]))
            for index, of in ((self.carriers, _brought), (self.links, _linked))
        )
        return replace(self, claims=claims, carriers=carriers, links=links)

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


def _taken(claims: Iterable[Claim | None]) -> set[tuple[str, str]]:
    return {
        (topic.source, topic.topic)
        for claim in claims
        if isinstance(claim, ApplicationClaim)
        for _, topic in claim.all_inputs()
    }


def _brought(claims: Iterable[Claim | None]) -> set[tuple[str, str]]:
    return {
        (route.ends(claim.source, claim.target)[1], route.written)
        for claim in claims
        if isinstance(claim, ConnectionClaim)
        for route in claim.topics.values()
    }


def _linked(claims: Iterable[Claim | None]) -> set[tuple[str, str]]:
    return {
        (claim.type.name, node)
        for claim in claims
        if isinstance(claim, ConnectionClaim) and claim.type is not ConnectionType.MQTT
        for node in (claim.source, claim.target)
    }


def _reindex(
    index: HashTrieMap[tuple[str, str], HashTrieSet[str]],
    subject: str,
    before: set[tuple[str, str]],
    still: set[tuple[str, str]],
    added: set[tuple[str, str]],
) -> HashTrieMap[tuple[str, str], HashTrieSet[str]]:
    for key in before - still:
        rest = index[key].discard(subject)
        index = index.insert(key, rest) if rest else index.remove(key)
    for key in added:
        known = index.get(key, HashTrieSet())
        if subject not in known:
            index = index.insert(key, known.insert(subject))
    return index


def differences(before: Ledger, after: Ledger, keys: Iterable[ClaimKey]) -> tuple[ClaimChange, ...]:
    """Return the claims at ``keys`` that are not the same in both ledgers."""
    changes = (ClaimChange(before.get(key), after.get(key)) for key in dict.fromkeys(keys))
    return tuple(change for change in changes if change.before != change.after)
