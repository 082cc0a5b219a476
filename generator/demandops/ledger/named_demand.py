"""Demands that name themselves: put (replace), release, renew, and the end of a lease.

A demand is all claims with its id. It belongs to whom it stands in the name of: a request in
nobody's name of theirs is refused, so that an id chosen twice by chance takes nothing away.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import datetime
from types import MappingProxyType

from demandops.demand import route as routes
from demandops.demand.claim import (
    ApplicationClaim,
    Claim,
    ClaimKey,
    ConnectionClaim,
    Subject,
    SubjectKind,
)
from demandops.demand.demand_request import (
    ApplicationDemand,
    ConnectionDemand,
    ConnectionType,
    DemandRequest,
)
from demandops.demand.lease import Term, renewed
from demandops.errors import Fault, Refused, fault
from demandops.ledger.join import application_conflicts, connection_conflicts, touched, united
from demandops.ledger.ledger import Changes, Ledger, differences


def put(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Make a demand what ``request`` lists, and release what it held beyond that.

    Raises:
        Refused: where it belongs to others, or contradicts what other demands hold.
    """
    held = ledger.of_demand(request.demand)
    _refuse_strangers(held, request)
    start = ledger
    others = ledger
    for claim in held:  # a demand does not contradict itself: it may move an application
        others = others.replace(claim.key, None)
    ledger = others
    faults: list[Fault] = []
    keys = [claim.key for claim in held]
    for index, app in enumerate(request.applications):
        faults += application_conflicts(f"applications[{index}]", app, others.application(app.id))
        key = ClaimKey(Subject(SubjectKind.APPLICATION, app.id), request.demand)
        faults += _twice(f"applications[{index}].id", key, ledger)
        ledger = ledger.replace(key, _application(request, app, start.get(key), now))
        keys.append(key)
    for index, connection in enumerate(request.connections):
        faults += connection_conflicts(
            f"connections[{index}]", connection, others.connection(connection.id)
        )
        key = ClaimKey(Subject(SubjectKind.CONNECTION, connection.id), request.demand)
        faults += _twice(f"connections[{index}].id", key, ledger)
        ledger = ledger.replace(key, _connection(request, connection, start.get(key), now))
        keys.append(key)
    if faults:
        raise Refused(faults)
    return ledger, Changes(claims=differences(start, ledger, keys))


def _twice(where: str, key: ClaimKey, ledger: Ledger) -> Iterator[Fault]:
    if ledger.get(key) is not None:
        yield fault(where, f"'{key.subject.id}' is listed twice; list it once, with all it takes")


def _application(
    request: DemandRequest, app: ApplicationDemand, standing: Claim | None, now: datetime
) -> ApplicationClaim:
    claim = ApplicationClaim(
        application=app.id,
        demand=request.demand,
        request=request.id,
        requesters=tuple(sorted(set(app.requesters))),
        booked=now,
        appdef=app.appdef,
        node=app.node,
        inputs=MappingProxyType(
            {role: united((), topics) for role, topics in sorted(app.inputs.items()) if topics}
        ),
        parameters=MappingProxyType(dict(app.parameters)),
        version=app.version,
        lease=renewed(standing.lease if standing else None, app.term, now),
    )
    return touched(claim, standing, now)


def _connection(
    request: DemandRequest, asked: ConnectionDemand, standing: Claim | None, now: datetime
) -> ConnectionClaim:
    claim = ConnectionClaim(
        connection=asked.id,
        demand=request.demand,
        request=request.id,
        requesters=tuple(sorted(set(asked.requesters))),
        booked=now,
        type=ConnectionType(asked.type),
        source=asked.source,
        target=asked.target,
        broker=asked.broker,
        topics=MappingProxyType(routes.merge_routes(asked.topics)),
        lease=renewed(standing.lease if standing else None, asked.term, now),
    )
    return touched(claim, standing, now)


def release(ledger: Ledger, request: DemandRequest) -> tuple[Ledger, Changes]:
    """Release all that a demand holds.

    Raises:
        Refused: where it holds nothing, or belongs to others.
    """
    return _without(ledger, _owned(ledger, request))


def renew(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Renew the leases of a demand by their own terms; what has none stays as it is.

    Raises:
        Refused: where it holds nothing, or belongs to others.
    """
    start = ledger
    held = _owned(ledger, request)
    for claim in held:
        if claim.lease is None:
            continue
        term = Term(claim.lease.seconds, claim.lease.slack)
        ledger = ledger.replace(claim.key, replace(claim, lease=claim.lease.renewed(term, now)))
    return ledger, Changes(claims=differences(start, ledger, [claim.key for claim in held]))


def expire(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Release what of a demand has come to the end of its lease; nothing where it was renewed."""
    held = ledger.of_demand(request.demand)
    return _without(ledger, [c for c in held if c.lease is not None and c.lease.expires_at < now])


def _without(ledger: Ledger, claims: Iterable[Claim]) -> tuple[Ledger, Changes]:
    start, keys = ledger, [claim.key for claim in claims]
    for key in keys:
        ledger = ledger.replace(key, None)
    return ledger, Changes(claims=differences(start, ledger, keys))


def _owned(ledger: Ledger, request: DemandRequest) -> tuple[Claim, ...]:
    held = ledger.of_demand(request.demand)
    if not held:
        near = sorted(
            {
                claim.demand
                for requester in request.own_requesters
                for claim in ledger.of_requester(requester)
            }
        )
        known = f"; demands in this name: {', '.join(near[:5])}" if near else ""
        message = f"'{request.demand}' holds nothing{known}"
        raise Refused([fault("demand", message, code="not-held")])
    _refuse_strangers(held, request)
    return held


def _refuse_strangers(held: Iterable[Claim], request: DemandRequest) -> None:
    owners = sorted({requester for claim in held for requester in claim.requesters})
    if owners and not set(owners) & set(request.requesters()):
        message = (
            f"'{request.demand}' is a demand of {', '.join(owners)}; name one of them, or choose "
            "another demand id"
        )
        raise Refused([fault("demand", message, code="not-yours")])
