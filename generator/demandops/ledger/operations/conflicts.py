"""Contradictions between a demand and existing claims on the same application or connection."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from demandops.connections import route as routes
from demandops.connections.connection import Connection
from demandops.connections.route import Route
from demandops.demand.application import Application
from demandops.demand.claim import Claim
from demandops.demand.demand_request import Demanded
from demandops.errors import Fault
from demandops.ledger.ledger import Ledger


def conflicts(one: Demanded, ledger: Ledger, *, above: bool = False) -> Iterator[Fault]:
    """Yield the faults of a demanded application or connection that contradicts claims on it.

    With ``above``, the messages say that ``one`` contradicts an earlier item of the same request.
    """
    if isinstance(one.held, Application):
        yield from _of_application(one, one.held, ledger, above)
    else:
        yield from _of_connection(one, one.held, ledger, above)


def _contradicts(above: bool) -> str:
    return f"contradicts {'an item above' if above else 'an existing claim'}"


def _held(id: str, requesters: Iterable[str], above: bool) -> str:
    return f"'{id}' is {'listed for' if above else 'held by'} {', '.join(requesters)}"


def _of_application(
    one: Demanded, app: Application, ledger: Ledger, above: bool
) -> Iterator[Fault]:
    claim = ledger.first_claim(app.subject)
    if claim is None:
        return
    held, known = _held(app.id, claim.requesters, above), claim.application
    wait = "" if above else ", or wait until the application is released"
    for name, new, current, holding, remedy in (
        (
            "node",
            app.node,
            known.node,
            "on",
            f"request node '{known.node}'{wait}",
        ),
        ("appdef", app.appdef, known.appdef, "as", "use another application id"),
    ):
        if new != current:
            yield one.fault(
                name,
                f"'{new}' {_contradicts(above)}: {held} {holding} '{current}'; {remedy}",
                code="conflict",
            )
            return


def _of_connection(
    one: Demanded, demanded: Connection, ledger: Ledger, above: bool
) -> Iterator[Fault]:
    for claim in ledger.connection_claims(demanded.id):
        held, known = _held(demanded.id, claim.requesters, above), claim.connection
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
                f"'{new}' {_contradicts(above)}: {held} with {name} '{current}'; use "
                f"the same {name}, or another connection id",
                code="conflict",
            )
            return
        yield from _of_routes(one, demanded, claim, held, above)


def _of_routes(
    one: Demanded, demanded: Connection, claim: Claim, held: str, above: bool
) -> Iterator[Fault]:
    by_source = {route.source: route for route in claim.connection.topics}
    carried_back = {route.target: route for route in claim.connection.topics if route.reverse}
    for index, route in enumerate(demanded.topics):
        where, current = f"topics[{index}]", by_source.get(route.source)
        if current is not None:
            yield from _of_route(one, where, route, current, held, above)
        elif route.reverse and (other := carried_back.get(route.target)):
            yield one.fault(
                f"{where}.target",
                f"connection {held} and already carries '{route.target}' back to "
                f"'{other.source}'; a connection carries a target topic back to only one source "
                "topic, so use a second connection",
                code="conflict",
            )


def _of_route(
    one: Demanded, where: str, route: Route, current: Route, held: str, above: bool
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
            f"{name} {new} of '{route.source}' {_contradicts(above)}: {held} with "
            f"{name} {old}; use the same {name}, or a second connection",
            code="conflict",
        )
