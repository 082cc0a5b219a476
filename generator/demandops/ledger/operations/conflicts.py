"""Why a demand contradicts existing claims on the same application or connection."""

from __future__ import annotations

from collections.abc import Iterator

from demandops.connections import route as routes
from demandops.connections.route import Route
from demandops.demand.claim import ApplicationClaim, ConnectionClaim, Subject, SubjectKind
from demandops.demand.demand_request import ApplicationDemand, ConnectionDemand
from demandops.errors import Fault, fault
from demandops.ledger.ledger import Ledger


def application_conflicts(where: str, app: ApplicationDemand, ledger: Ledger) -> Iterator[Fault]:
    """Yield why a demanded application contradicts the first existing claim on it, if it does."""
    claim = ledger.first_claim(Subject(SubjectKind.APPLICATION, app.id))
    if not isinstance(claim, ApplicationClaim):
        return
    held = f"'{app.id}' is held by {', '.join(claim.requesters)}"
    if claim.node != app.node:
        yield fault(
            f"{where}.node",
            f"'{app.node}' contradicts an existing claim: {held} on '{claim.node}'; ask for "
            "that node, or wait until it is released",
            code="conflict",
        )
    elif claim.appdef != app.appdef:
        yield fault(
            f"{where}.appdef",
            f"'{app.appdef}' contradicts an existing claim: {held} as '{claim.appdef}'; use "
            "another application id",
            code="conflict",
        )
    elif claim.version != app.version:
        yield fault(
            f"{where}.version",
            f"'{app.version}' contradicts an existing claim: {held} in version "
            f"'{claim.version}'; ask for the same, or use another application id",
            code="conflict",
        )


def connection_conflicts(where: str, demanded: ConnectionDemand, ledger: Ledger) -> Iterator[Fault]:
    """Yield why a demanded connection contradicts existing claims on it."""
    for claim in ledger.connection_claims(demanded.id):
        held = f"'{demanded.id}' is held by {', '.join(claim.requesters)}"
        for name, new, current in (
            ("type", str(demanded.chosen_type), claim.type.name),
            ("source", demanded.source, claim.source),
            ("target", demanded.target, claim.target),
            ("broker", demanded.broker, claim.broker),
        ):
            if new == current or (name == "broker" and not (new and current)):
                continue
            yield fault(
                f"{where}.{name}",
                f"'{new}' contradicts an existing claim: {held} with {name} '{current}'; use "
                "the same, or another connection id",
                code="conflict",
            )
            return
        for index, route in enumerate(demanded.topics):
            yield from _route_conflicts(f"{where}.topics[{index}]", route, claim, held)


def _route_conflicts(
    where: str, demanded: Route, claim: ConnectionClaim, held: str
) -> Iterator[Fault]:
    current = claim.topics.get(demanded.source)
    if current is None:
        for route in claim.topics.values() if demanded.reverse else ():
            if route.reverse and route.target == demanded.target:
                yield fault(
                    f"{where}.target",
                    f"'{demanded.target}' is carried back to '{route.source}' already: {held}; one "
                    "topic goes to one place, use a second connection",
                    code="conflict",
                )
        return
    if current.target != demanded.target:
        yield fault(
            f"{where}.target",
            f"'{demanded.source}' goes to '{current.target}' already: {held}; one source topic has "
            "one target, use a second connection",
            code="conflict",
        )
    for name, old, new in routes.contradictions(current, demanded):
        yield fault(
            f"{where}.{name}",
            f"{name} {new} of '{demanded.source}' contradicts an existing claim: {held} with "
            f"{name} {old}; use the same, or a second connection",
            code="conflict",
        )
