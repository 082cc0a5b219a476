"""Contradictions between a demand and existing claims on the same application or connection."""

from __future__ import annotations

from collections.abc import Iterator

from demandops.connections import route as routes
from demandops.connections.connection import Connection
from demandops.demand.application import Application
from demandops.demand.claim import Claim
from demandops.demand.demand_request import Demanded
from demandops.errors import Fault
from demandops.ledger.ledger import Ledger


def conflicts(item: Demanded, ledger: Ledger, *, above: bool = False) -> Iterator[Fault]:
    """Yield the faults of a demanded application or connection that contradicts claims on it.

    With ``above``, the messages say that ``item`` contradicts an earlier item of the same request.
    """
    if isinstance(item.held, Application):
        yield from _application_conflicts(item, item.held, ledger, above)
    else:
        yield from _connection_conflicts(item, item.held, ledger, above)


def _contradicts(above: bool) -> str:
    return f"contradicts {'an item above' if above else 'an existing claim'}"


def _held(claim: Claim, above: bool) -> str:
    holders = ", ".join(claim.requesters)
    return f"'{claim.held.id}' is {'listed for' if above else 'held by'} {holders}"


def _application_conflicts(
    item: Demanded, app: Application, ledger: Ledger, above: bool
) -> Iterator[Fault]:
    # all claims on an application agree about its node and type, so the first speaks for all
    claim = ledger.first_claim(app.subject)
    if claim is None:
        return
    booked = claim.application
    wait = "" if above else ", or wait until the application is released"
    for name, new, current, holding, remedy in (
        ("node", app.node, booked.node, "on", f"request node '{booked.node}'{wait}"),
        ("appdef", app.appdef, booked.appdef, "as", "use another application id"),
    ):
        if new != current:
            message = (
                f"'{new}' {_contradicts(above)}: {_held(claim, above)} {holding} '{current}'; "
                f"{remedy}"
            )
            yield item.fault(name, message, code="conflict")
            return


def _connection_conflicts(
    item: Demanded, demanded: Connection, ledger: Ledger, above: bool
) -> Iterator[Fault]:
    for claim in ledger.connection_claims(demanded.id):
        booked = claim.connection
        for name, new, current in (
            ("type", str(demanded.type), str(booked.type)),
            ("source", demanded.source, booked.source),
            ("target", demanded.target, booked.target),
            ("broker", demanded.broker, booked.broker),
        ):
            # a broker that only one of the two names is no contradiction
            if new == current or (name == "broker" and not (new and current)):
                continue
            message = (
                f"'{new}' {_contradicts(above)}: {_held(claim, above)} with {name} '{current}'; "
                f"use the same {name}, or another connection id"
            )
            yield item.fault(name, message, code="conflict")
            return
        yield from _route_conflicts(item, demanded, claim, above)


def _route_conflicts(
    item: Demanded, demanded: Connection, claim: Claim, above: bool
) -> Iterator[Fault]:
    held = _held(claim, above)
    by_source = {route.source: route for route in claim.connection.topics}
    carried_back = {route.target: route for route in claim.connection.topics if route.reverse}
    for index, route in enumerate(demanded.topics):
        where, current = f"topics[{index}]", by_source.get(route.source)
        if current is None:
            if route.reverse and (other := carried_back.get(route.target)):
                message = (
                    f"connection {held} and already carries '{route.target}' back to "
                    f"'{other.source}'; a connection carries a target topic back to only one "
                    "source topic, so use a second connection"
                )
                yield item.fault(f"{where}.target", message, code="conflict")
            continue
        if current.target != route.target:
            message = (
                f"connection {held} and already carries '{route.source}' to '{current.target}'; a "
                "connection carries a source topic to only one target topic, so use a second "
                "connection"
            )
            yield item.fault(f"{where}.target", message, code="conflict")
        for name, old, new in routes.contradictions(current, route):
            message = (
                f"{name} {new} of '{route.source}' {_contradicts(above)}: {held} with "
                f"{name} {old}; use the same {name}, or a second connection"
            )
            yield item.fault(f"{where}.{name}", message, code="conflict")
