"""Contradictions between a demand and existing claims on the same application or connection."""

from __future__ import annotations

from collections.abc import Iterator

from demandops.connections import route as routes
from demandops.connections.connection import Connection
from demandops.connections.route import Route
from demandops.demand.application import Application
from demandops.demand.claim import Claim
from demandops.demand.demand_request import Demanded
from demandops.errors import Fault
from demandops.ledger.ledger import Ledger


def conflicts(one: Demanded, ledger: Ledger) -> Iterator[Fault]:
    """Yield the faults of a demanded application or connection that contradicts existing claims."""
    if isinstance(one.held, Application):
        yield from _of_application(one, one.held, ledger)
    else:
        yield from _of_connection(one, one.held, ledger)


def _of_application(one: Demanded, app: Application, ledger: Ledger) -> Iterator[Fault]:
    claim = ledger.first_claim(app.subject)
    if claim is None:
        return
    held, known = f"'{app.id}' is held by {', '.join(claim.requesters)}", claim.application
    for name, new, current, holding, remedy in (
        (
            "node",
            app.node,
            known.node,
            "on",
            f"request node '{known.node}', or wait until the application is released",
        ),
        ("appdef", app.appdef, known.appdef, "as", "use another application id"),
    ):
        if new != current:
            yield one.fault(
                name,
                f"'{new}' contradicts an existing claim: {held} {holding} '{current}'; {remedy}",
                code="conflict",
            )
            return


def _of_connection(one: Demanded, demanded: Connection, ledger: Ledger) -> Iterator[Fault]:
    for claim in ledger.connection_claims(demanded.id):
        held, known = f"'{demanded.id}' is held by {', '.join(claim.requesters)}", claim.connection
        for name, new, current in (
            ("type", str(demanded.type), str(known.type)),
            ("source", demanded.source, known.source),
            ("target", demanded.target, known.target),
            ("broker", demanded.broker, known.broker),
        ):
            if new == current or (name == "broker" and not (new and current)):
                continue
            yield one.fault(
                name,
                f"'{new}' contradicts an existing claim: {held} with {name} '{current}'; use "
                f"the same {name}, or another connection id",
                code="conflict",
            )
            return
        yield from _of_routes(one, demanded, claim, held)


def _of_routes(one: Demanded, demanded: Connection, claim: Claim, held: str) -> Iterator[Fault]:
    by_source = {route.source: route for route in claim.connection.topics}
    carried_back = {route.target: route for route in claim.connection.topics if route.reverse}
    for index, route in enumerate(demanded.topics):
        where, current = f"topics[{index}]", by_source.get(route.source)
        if current is not None:
            yield from _of_route(one, where, route, current, held)
        elif route.reverse and (other := carried_back.get(route.target)):
            yield one.fault(
                f"{where}.target",
                f"connection {held} and already carries '{route.target}' back to "
                f"'{other.source}'; a connection carries a target topic back to only one source "
                "topic, so use a second connection",
                code="conflict",
            )


def _of_route(
    one: Demanded, where: str, route: Route, current: Route, held: str
) -> Iterator[Fault]:
    if current.target != route.target:
        yield one.fault(
            f"{where}.target",
            f"connection {held} and already carries '{route.source}' to '{current.target}'; a "
            "connection carries a source topic to only one target topic, so use a second "
            "connection",
            code="conflict",
        )
    for name, old, new in routes.contradictions(current, route):
        yield one.fault(
            f"{where}.{name}",
            f"{name} {new} of '{route.source}' contradicts an existing claim: {held} with "
            f"{name} {old}; use the same {name}, or a second connection",
            code="conflict",
        )
