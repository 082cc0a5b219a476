"""Booking: what a request that joins adds, and what of it contradicts standing claims."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import datetime
from types import MappingProxyType
from typing import TypeVar

from demandops.demand import route as routes
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
    ApplicationDemand,
    ConnectionDemand,
    ConnectionType,
    DemandRequest,
    InputTopic,
)
from demandops.demand.lease import renewed
from demandops.demand.route import Route
from demandops.errors import Fault, Refused, fault
from demandops.ledger.ledger import Changes, Ledger, differences


def join(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Book a whole request; raise :class:`Refused` with every contradiction, booking nothing."""
    faults: list[Fault] = []
    start = ledger
    keys: list[ClaimKey] = []
    for index, app in enumerate(request.applications):
        standing = ledger.application(app.id)
        faults += application_conflicts(f"applications[{index}]", app, standing)
        claim: Claim = _joined_application(ledger, request.id, app, now)
        ledger = ledger.replace(claim.key, claim)
        keys.append(claim.key)
    for index, connection in enumerate(request.connections):
        held = ledger.connection(connection.id)
        faults += connection_conflicts(f"connections[{index}]", connection, held)
        claim = _joined_connection(ledger, request.id, connection, now)
        ledger = ledger.replace(claim.key, claim)
        keys.append(claim.key)
    if faults:
        raise Refused(faults)
    return ledger, Changes(claims=differences(start, ledger, keys))


def application_conflicts(
    where: str, app: ApplicationDemand, standing: Iterable[ApplicationClaim]
) -> Iterator[Fault]:
    """Yield what of a demanded application contradicts claims that stand on it."""
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
        if claim.version != app.version:
            yield fault(
                f"{where}.version",
                f"'{app.version}' contradicts what stands: {held} in version '{claim.version}'; "
                "ask for the same, or use another application id",
                code="conflict",
            )
            return


def connection_conflicts(
    where: str, asked: ConnectionDemand, standing: Iterable[ConnectionClaim]
) -> Iterator[Fault]:
    """Yield what of a demanded connection contradicts claims that stand on it."""
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
        for index, route in enumerate(asked.topics):
            yield from _route_conflicts(f"{where}.topics[{index}]", route, claim, held)


def _route_conflicts(
    where: str, asked: Route, claim: ConnectionClaim, held: str
) -> Iterator[Fault]:
    stands = claim.topics.get(asked.source)
    if stands is None:
        for route in claim.topics.values() if asked.reverse else ():
            if route.reverse and route.target == asked.target:
                yield fault(
                    f"{where}.target",
                    f"'{asked.target}' is carried back to '{route.source}' already: {held}; one "
                    "topic goes to one place, use a second connection",
                    code="conflict",
                )
        return
    if stands.target != asked.target:
        yield fault(
            f"{where}.target",
            f"'{asked.source}' goes to '{stands.target}' already: {held}; one source topic has "
            "one target, use a second connection",
            code="conflict",
        )
    for name, value, wanted in routes.contradictions(stands, asked):
        yield fault(
            f"{where}.{name}",
            f"{name} {wanted} of '{asked.source}' contradicts what stands: {held} with {name} "
            f"{value}; use the same, or a second connection",
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
        role: united(known.get(role, ()), app.inputs.get(role, ()))
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
        version=app.version,
        lease=renewed(standing.lease if standing else None, app.term, now),
    )
    return touched(claim, standing, now)


AnyClaim = TypeVar("AnyClaim", ApplicationClaim, ConnectionClaim)


def touched(claim: AnyClaim, standing: Claim | None, now: datetime) -> AnyClaim:
    """Return a claim booked at ``now``, or as before where nothing but its lease differs."""
    if standing is None:
        return replace(claim, booked=now)
    kept = replace(claim, booked=standing.booked)
    return kept if replace(kept, lease=standing.lease) == standing else replace(claim, booked=now)


def united(known: Iterable[InputTopic], asked: Iterable[InputTopic]) -> tuple[InputTopic, ...]:
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
    known = standing.topics if isinstance(standing, ConnectionClaim) else {}
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
        topics=MappingProxyType(routes.merge_routes([*known.values(), *asked.topics])),
        lease=renewed(standing.lease if standing else None, asked.term, now),
    )
    return touched(claim, standing, now)
