"""A shutdown: which claims it matches, and what remains of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import datetime
from types import MappingProxyType
from typing import TypeAlias

from demandops.demand.claim import (
    ApplicationClaim,
    Claim,
    ClaimKey,
    ConnectionClaim,
    Subject,
    SubjectKind,
    demand_id,
)
from demandops.demand.demand_request import (
    AUTO,
    ApplicationDemand,
    ConnectionDemand,
    DemandRequest,
    InputTopic,
)
from demandops.errors import Fault, Refused, fault
from demandops.ledger.ledger import Changes, Ledger, claim_changes


def shut_down(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Release what a shutdown lists.

    Raises:
        Refused: if none of it is held.
    """
    start = ledger
    keys: list[ClaimKey] = []
    not_held: list[str] = []
    for subject, listed in _listed(request):
        # look in ``start``: a subject that is listed twice means the same claim both times
        claim = _matching_claim(start.claims_on(subject), request.id, listed)
        if claim is None:
            not_held.append(f"{subject} for {', '.join(listed.requesters)}")
            continue
        not_held += [f"{subject}: {name}" for name in _subtract(claim, listed, now)[1]]
        left = ledger.get(claim.key)
        if left is not None:
            ledger = ledger.replace(claim.key, _subtract(left, listed, now)[0])
        keys.append(claim.key)
    changes = claim_changes(start, ledger, keys)
    if not changes:
        raise Refused([_nothing_held(start, request)])
    return ledger, Changes(claims=changes, not_held=tuple(dict.fromkeys(not_held)))


Demanded: TypeAlias = ApplicationDemand | ConnectionDemand


def _listed(request: DemandRequest) -> Iterator[tuple[Subject, Demanded]]:
    for app in request.applications:
        yield Subject(SubjectKind.APPLICATION, app.id), app
    for connection in request.connections:
        yield Subject(SubjectKind.CONNECTION, connection.id), connection


def _matching_claim(claims: Iterable[Claim], request: str, listed: Demanded) -> Claim | None:
    """Return the claim that a shutdown matches, or ``None`` if none or several could match."""
    claims = [claim for claim in claims if _same_ends(claim, listed)]
    requesters = set(listed.requesters)
    own_id = demand_id(request, requesters)
    exact = [claim for claim in claims if set(claim.requesters) == requesters]
    meant = (
        [claim for claim in exact if claim.demand == own_id]
        or [claim for claim in exact if claim.request == request]
        or exact
        or [claim for claim in claims if set(claim.requesters) >= requesters]
    )
    return meant[0] if len(meant) == 1 else None


def _same_ends(claim: Claim, listed: Demanded) -> bool:
    if isinstance(claim, ApplicationClaim) and isinstance(listed, ApplicationDemand):
        return listed.node in ("", claim.node) and listed.appdef == claim.appdef
    if isinstance(claim, ConnectionClaim) and isinstance(listed, ConnectionDemand):
        return (
            listed.source in ("", claim.source)
            and listed.target in ("", claim.target)
            and listed.type in (AUTO, claim.type.number)
        )
    return False


def _subtract(claim: Claim, listed: Demanded, now: datetime) -> tuple[Claim | None, list[str]]:
    """Return what remains of a claim, if anything, and which topics it did not hold."""
    if isinstance(claim, ApplicationClaim) and isinstance(listed, ApplicationDemand):
        return _subtract_inputs(claim, listed, now)
    if isinstance(claim, ConnectionClaim) and isinstance(listed, ConnectionDemand):
        return _subtract_topics(claim, listed, now)
    raise AssertionError("the claim is of the kind that the shutdown lists")  # pragma: no cover


def _subtract_inputs(
    claim: ApplicationClaim, listed: ApplicationDemand, now: datetime
) -> tuple[Claim | None, list[str]]:
    if not any(listed.inputs.values()):
        return None, []
    remaining: dict[str, tuple[InputTopic, ...]] = {}
    missing = []
    for role in sorted({*claim.inputs, *listed.inputs}):
        held = claim.inputs.get(role, ())
        by_name: dict[str, list[InputTopic]] = {}
        for topic in held:
            by_name.setdefault(topic.topic, []).append(topic)
        gone: set[InputTopic] = set()
        for topic in listed.inputs.get(role, ()):
            named = by_name.get(topic.topic, ())
            found = {one for one in named if topic.source in ("", one.source)}
            gone |= found
            if not found:
                missing.append(f"{role} {topic.topic} of {topic.source}")
        left = tuple(topic for topic in held if topic not in gone)
        if left:
            remaining[role] = left
    if not remaining:
        return None, missing
    if remaining == dict(claim.inputs):
        return claim, missing
    return replace(claim, inputs=MappingProxyType(remaining), booked=now), missing


def _subtract_topics(
    claim: ConnectionClaim, listed: ConnectionDemand, now: datetime
) -> tuple[Claim | None, list[str]]:
    if not listed.topics:
        return None, []
    gone = {route.source for route in listed.topics}
    missing = [f"topic {topic}" for topic in sorted(gone - set(claim.topics))]
    remaining = {source: route for source, route in claim.topics.items() if source not in gone}
    if not remaining:
        return None, missing
    if remaining == dict(claim.topics):
        return claim, missing
    return replace(claim, topics=MappingProxyType(remaining), booked=now), missing


def _nothing_held(ledger: Ledger, request: DemandRequest) -> Fault:
    """Return the fault for a shutdown that matches no claim; it suggests similar claims."""
    near = [
        f"{claim.subject} for {', '.join(claim.requesters)} (request '{claim.request}')"
        for subject, _ in _listed(request)
        for claim in ledger.claims_on(subject)
    ]
    where = "applications[0].id" if request.applications else "connections[0].id"
    if not near:
        requesters = set(request.requesters())
        near = [
            f"{claim.subject} for {', '.join(claim.requesters)}"
            for requester in sorted(requesters)
            for claim in ledger.claims_of_requester(requester)
        ]
    shown = "; ".join(dict.fromkeys(near[:5])) or "none"
    return fault(
        where,
        f"nothing that the shutdown lists is held; similar claims: {shown}",
        code="not-held",
    )
