"""The ledger: which demand holds which subject.

:func:`apply` books a request or releases what it holds, as a whole or not at all, and says what
changed. A :class:`Ledger` never changes: it is a set of persistent maps, so that a new one costs
what the request touches and not what is booked. Semantics: ``docs/architecture.md``, "Booking".
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from types import MappingProxyType
from typing import TypeAlias, TypeVar

from rpds import HashTrieMap, HashTrieSet

from generator.demand.claim import (
    ApplicationClaim,
    Claim,
    ClaimKey,
    ConnectionClaim,
    Subject,
    SubjectKind,
    demand_id,
)
from generator.demand.request import (
    ApplicationDemand,
    ConnectionDemand,
    ConnectionType,
    DemandRequest,
    InputTopic,
    Operation,
)
from generator.errors import Fault, Refused, fault

Key = TypeVar("Key")

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
    """All claims, with the two look-ups that planning needs.

    ``takers``: (source node, topic) → applications that take that topic in.
    ``carriers``: (target node, target topic) → connections that bring it there.
    """

    claims: HashTrieMap[Subject, Claims] = field(default_factory=HashTrieMap)
    takers: HashTrieMap[tuple[str, str], HashTrieSet[str]] = field(default_factory=HashTrieMap)
    carriers: HashTrieMap[tuple[str, str], HashTrieSet[str]] = field(default_factory=HashTrieMap)

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

    def subjects(self, kind: SubjectKind) -> list[str]:
        """Return the ids of all subjects of a kind that something holds, sorted."""
        return sorted(subject.id for subject in self.claims if subject.kind is kind)

    def taking(self, source: str, topic: str) -> tuple[str, ...]:
        """Return the applications that take ``topic`` of ``source`` in, sorted."""
        return tuple(sorted(self.takers.get((source, topic)) or ()))

    def carries(self, target: str, topic: str) -> bool:
        """Tell whether some connection brings ``topic`` to the node ``target``."""
        return (target, topic) in self.carriers

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
        carriers = _reindex(
            self.carriers,
            key.subject.id,
            _brought([old]),
            _brought(after.values()),
            _brought([claim]),
        )
        return replace(self, claims=claims, carriers=carriers)

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
        (claim.target, topic)
        for claim in claims
        if isinstance(claim, ConnectionClaim)
        for topic in claim.topics.values()
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


def apply(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Book what ``request`` joins, or release what its shutdown lists.

    Args:
        ledger: what is booked.
        request: an admitted request (:mod:`generator.demand.admission`).
        now: when it was received, with time zone; kept in claims that change.

    Returns:
        The new ledger and what changed. Booking twice changes nothing.

    Raises:
        Refused: with every contradiction to a standing claim, or where a shutdown lists nothing
            that is held. Nothing is booked then.
    """
    if request.operation is Operation.SHUTDOWN:
        return _release(ledger, request, now)
    return _book(ledger, request, now)


def _book(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    faults: list[Fault] = []
    start = ledger
    keys: list[ClaimKey] = []
    for index, app in enumerate(request.applications):
        standing = ledger.application(app.id)
        faults += _application_conflicts(f"applications[{index}]", app, standing)
        claim: Claim = _joined_application(ledger, request.id, app, now)
        ledger = ledger.replace(claim.key, claim)
        keys.append(claim.key)
    for index, connection in enumerate(request.connections):
        held = ledger.connection(connection.id)
        faults += _connection_conflicts(f"connections[{index}]", connection, held)
        claim = _joined_connection(ledger, request.id, connection, now)
        ledger = ledger.replace(claim.key, claim)
        keys.append(claim.key)
    if faults:
        raise Refused(faults)
    return ledger, Changes(claims=_differences(start, ledger, keys))


def _differences(
    before: Ledger, after: Ledger, keys: Iterable[ClaimKey]
) -> tuple[ClaimChange, ...]:
    changes = (ClaimChange(before.get(key), after.get(key)) for key in dict.fromkeys(keys))
    return tuple(change for change in changes if change.before != change.after)


def _application_conflicts(
    where: str, app: ApplicationDemand, standing: Iterable[ApplicationClaim]
) -> Iterator[Fault]:
    for claim in standing:
        held = f"'{app.id}' is held by {', '.join(claim.requesters)}"
        if claim.node != app.node:
            yield fault(
                f"{where}.node",
                f"'{app.node}' contradicts what stands: {held} on '{claim.node}'; ask for that "
                "node, or wait until it is released",
                code="conflict",
            )
            return
        if claim.appdef != app.appdef:
            yield fault(
                f"{where}.appdef",
                f"'{app.appdef}' contradicts what stands: {held} as '{claim.appdef}'; use another "
                "application id",
                code="conflict",
            )
            return


def _connection_conflicts(
    where: str, asked: ConnectionDemand, standing: Iterable[ConnectionClaim]
) -> Iterator[Fault]:
    for claim in standing:
        held = f"'{asked.id}' is held by {', '.join(claim.requesters)}"
        for name, wanted, stands in (
            ("type", ConnectionType(asked.type).name, claim.type.name),
            ("source", asked.source, claim.source),
            ("target", asked.target, claim.target),
            ("broker", asked.broker, claim.broker),
        ):
            if wanted == stands or (name == "broker" and not (wanted and stands)):
                continue
            yield fault(
                f"{where}.{name}",
                f"'{wanted}' contradicts what stands: {held} with {name} '{stands}'; use the same, "
                "or another connection id",
                code="conflict",
            )
            return
        for index, (source, target) in enumerate(asked.topics):
            if claim.topics.get(source, target) != target:
                yield fault(
                    f"{where}.topics[{index}].target",
                    f"'{source}' goes to '{claim.topics[source]}' already: {held}; one source "
                    "topic has one target, use a second connection",
                    code="conflict",
                )


def _joined_application(
    ledger: Ledger, request: str, app: ApplicationDemand, now: datetime
) -> ApplicationClaim:
    demand = demand_id(request, app.requesters)
    key = ClaimKey(Subject(SubjectKind.APPLICATION, app.id), demand)
    standing = ledger.get(key)
    known = standing.inputs if isinstance(standing, ApplicationClaim) else {}
    old = standing.parameters if isinstance(standing, ApplicationClaim) else {}
    inputs = {
        role: _united(known.get(role, ()), app.inputs.get(role, ()))
        for role in sorted({*known, *app.inputs})
    }
    claim = ApplicationClaim(
        application=app.id,
        demand=demand,
        request=request,
        requesters=tuple(sorted(set(app.requesters))),
        booked=standing.booked if standing else now,
        appdef=app.appdef,
        node=app.node,
        inputs=MappingProxyType({role: topics for role, topics in inputs.items() if topics}),
        parameters=MappingProxyType({**old, **app.parameters}),
    )
    return claim if claim == standing else replace(claim, booked=now)


def _united(known: Iterable[InputTopic], asked: Iterable[InputTopic]) -> tuple[InputTopic, ...]:
    """Unite topics by (topic, source); a type that is given later fills in one that was not."""
    types: dict[tuple[str, str], str] = {}
    for topic in (*known, *asked):
        key = (topic.topic, topic.source)
        types[key] = types.get(key) or topic.type
    return tuple(InputTopic(*key, type) for key, type in sorted(types.items()))


def _joined_connection(
    ledger: Ledger, request: str, asked: ConnectionDemand, now: datetime
) -> ConnectionClaim:
    demand = demand_id(request, asked.requesters)
    key = ClaimKey(Subject(SubjectKind.CONNECTION, asked.id), demand)
    standing = ledger.get(key)
    known: Mapping[str, str] = standing.topics if isinstance(standing, ConnectionClaim) else {}
    broker = standing.broker if isinstance(standing, ConnectionClaim) else ""
    claim = ConnectionClaim(
        connection=asked.id,
        demand=demand,
        request=request,
        requesters=tuple(sorted(set(asked.requesters))),
        booked=standing.booked if standing else now,
        type=ConnectionType(asked.type),
        source=asked.source,
        target=asked.target,
        broker=asked.broker or broker,
        topics=MappingProxyType(dict(sorted({**known, **dict(asked.topics)}.items()))),
    )
    return claim if claim == standing else replace(claim, booked=now)


def _release(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    start = ledger
    keys: list[ClaimKey] = []
    not_held: list[str] = []
    for subject, asked in _listed(request):
        claim = _meant(ledger.of(subject), request.id, asked)
        if claim is None:
            not_held.append(f"{subject} for {', '.join(asked.requesters)}")
            continue
        rest, missing = _subtracted(claim, asked, now)
        not_held += [f"{subject}: {name}" for name in missing]
        ledger = ledger.replace(claim.key, rest)
        keys.append(claim.key)
    changes = _differences(start, ledger, keys)
    if not changes:
        raise Refused([_nothing_held(start, request)])
    return ledger, Changes(claims=changes, not_held=tuple(dict.fromkeys(not_held)))


Asked: TypeAlias = ApplicationDemand | ConnectionDemand


def _listed(request: DemandRequest) -> Iterator[tuple[Subject, Asked]]:
    """Yield what a shutdown lists, each once, so that a repetition does not count as not held."""
    seen: list[Asked] = []
    for kind, asked_of_kind in (
        (SubjectKind.APPLICATION, request.applications),
        (SubjectKind.CONNECTION, request.connections),
    ):
        for asked in asked_of_kind:
            if asked not in seen:
                seen.append(asked)
                yield Subject(kind, asked.id), asked


def _meant(claims: Iterable[Claim], request: str, asked: Asked) -> Claim | None:
    """Return the claim that a shutdown means, or nothing: nothing is ever released by guess."""
    claims = [claim for claim in claims if _same_ends(claim, asked)]
    requesters = set(asked.requesters)
    exact = [claim for claim in claims if set(claim.requesters) == requesters]
    for claim in exact:
        if claim.request == request:
            return claim
    if exact:
        return exact[0] if len(exact) == 1 else None
    wider = [claim for claim in claims if set(claim.requesters) >= requesters]
    return wider[0] if len(wider) == 1 else None


def _same_ends(claim: Claim, asked: Asked) -> bool:
    if isinstance(claim, ApplicationClaim) and isinstance(asked, ApplicationDemand):
        return asked.node in ("", claim.node) and asked.appdef == claim.appdef
    if isinstance(claim, ConnectionClaim) and isinstance(asked, ConnectionDemand):
        return (
            asked.source in ("", claim.source)
            and asked.target in ("", claim.target)
            and asked.type == claim.type.value
        )
    return False


def _subtracted(claim: Claim, asked: Asked, now: datetime) -> tuple[Claim | None, list[str]]:
    """Return what remains of ``claim`` (nothing: it is dropped) and what of it was not held."""
    if isinstance(claim, ApplicationClaim) and isinstance(asked, ApplicationDemand):
        return _subtracted_inputs(claim, asked, now)
    if isinstance(claim, ConnectionClaim) and isinstance(asked, ConnectionDemand):
        return _subtracted_topics(claim, asked, now)
    raise AssertionError("a claim and what is asked are of one kind")  # pragma: no cover


def _subtracted_inputs(
    claim: ApplicationClaim, asked: ApplicationDemand, now: datetime
) -> tuple[Claim | None, list[str]]:
    if not any(asked.inputs.values()):
        return None, []
    rest: dict[str, tuple[InputTopic, ...]] = {}
    missing = []
    for role in sorted({*claim.inputs, *asked.inputs}):
        held = claim.inputs.get(role, ())
        gone: set[InputTopic] = set()
        for topic in asked.inputs.get(role, ()):
            found = {t for t in held if t.topic == topic.topic and topic.source in ("", t.source)}
            gone |= found
            if not found:
                missing.append(f"{role} {topic.topic} of {topic.source}")
        left = tuple(topic for topic in held if topic not in gone)
        if left:
            rest[role] = left
    if not rest:
        return None, missing
    if rest == dict(claim.inputs):
        return claim, missing
    return replace(claim, inputs=MappingProxyType(rest), booked=now), missing


def _subtracted_topics(
    claim: ConnectionClaim, asked: ConnectionDemand, now: datetime
) -> tuple[Claim | None, list[str]]:
    if not asked.topics:
        return None, []
    gone = {source for source, _ in asked.topics}
    missing = [f"topic {topic}" for topic in sorted(gone - set(claim.topics))]
    rest = {source: target for source, target in claim.topics.items() if source not in gone}
    if not rest:
        return None, missing
    if rest == dict(claim.topics):
        return claim, missing
    return replace(claim, topics=MappingProxyType(rest), booked=now), missing


def _nothing_held(ledger: Ledger, request: DemandRequest) -> Fault:
    """Say that a shutdown finds nothing, with the claims that come near: a typo must show."""
    near = [
        f"{claim.subject} for {', '.join(claim.requesters)} (request '{claim.request}')"
        for subject, _ in _listed(request)
        for claim in ledger.of(subject)
    ]
    where = "applications[0].id" if request.applications else "connections[0].id"
    if not near:
        wanted = set(request.requesters())
        near = [
            f"{claim.subject} for {', '.join(claim.requesters)}"
            for claim in sorted(ledger, key=lambda claim: (str(claim.subject), claim.demand))
            if wanted & set(claim.requesters)
        ]
    shown = "; ".join(dict.fromkeys(near[:5])) or "none"
    return fault(
        where,
        f"nothing that the shutdown lists is held; claims that come near: {shown}",
        code="not-held",
    )
