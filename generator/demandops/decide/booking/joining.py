"""The owners of a demand that has an id: the requesters for whom it holds claims or waits.

A request is refused if it names none of the owners. So if a second requester chooses the same
demand id by chance, its requests cannot change the demand of the first requester.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import datetime

from demandops.base.errors import Fault, Refused, fault
from demandops.base.naming import Subject
from demandops.connections import connection as routes
from demandops.connections.connection import Connection
from demandops.model.demand.application import Application
from demandops.model.demand.claim import Claim, ClaimKey, demand_id, renewed
from demandops.model.demand.demand_request import Demanded, DemandRequest, Join, Put
from demandops.model.ledger.ledger import Changes, Ledger, claim_changes


def is_waiting(ledger: Ledger, request: DemandRequest) -> bool:
    """Return whether the request's demand waits; raise :class:`Refused` if it is of other
    requesters.
    """
    waiting = ledger.waiting.get(request.demand)
    if waiting is not None:
        _refuse_others(waiting.requesters, request)
    return waiting is not None


def owned_claims(ledger: Ledger, request: DemandRequest) -> tuple[Claim, ...]:
    """Return the claims of the demand; raise Refused if it holds none or is of others."""
    held = ledger.claims_of_demand(request.demand)
    if not held:
        demands = sorted(
            {
                claim.demand
                for requester in request.own_requesters
                for claim in ledger.claims_of_requester(requester)
                if claim.keeping_override is None
            }
        )
        hint = "the demand has ended, or was never booked; see 'demandops log'"
        if demands:
            hint = f"the requesters of this request hold, for example, {', '.join(demands[:5])}"
        message = f"'{request.demand}' holds nothing; {hint}"
        raise Refused.at("demand", message, code="not-held")
    refuse_other_owners(held, request)
    return held


def refuse_other_owners(held: Iterable[Claim], request: DemandRequest) -> None:
    """Raise :class:`Refused` if the claims belong to none of the request's requesters."""
    _refuse_others({requester for claim in held for requester in claim.requesters}, request)


def _refuse_others(owners: Iterable[str], request: DemandRequest) -> None:
    owners = sorted(owners)
    if owners and not set(owners) & set(request.requesters()):
        message = (
            f"'{request.demand}' is a demand of {', '.join(owners)}; name one of them, or choose "
            "another demand id"
        )
        raise Refused.at("demand", message, code="not-yours")


# ---- conflicts ----
#
# Contradictions between a demand and existing claims on the same application or connection.


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


# ---- the booking of one demanded application or connection ----


def book(
    ledger: Ledger,
    item: Demanded,
    request: str,
    key: ClaimKey,
    current: Claim | None,
    now: datetime,
    *,
    joined: bool = False,
) -> Ledger:
    """Return the ledger with a claim on a demanded application or connection.

    ``current`` is the demand's claim on the same subject so far. A join keeps what it holds.
    """
    claim = Claim(
        held=item.held.booked(),
        demand=key.demand,
        request=request,
        requesters=tuple(sorted(set(item.requesters))),
        booked=now,
        lease=renewed(current.lease if current else None, item.term, now),
        joined=joined,
    )
    if joined and current:
        claim = claim.extending(current)
    return ledger.replace(key, claim.after_booking(current))


# ---- a join: a goal of the reference's action adds to what its demand already holds ----


def join(ledger: Ledger, request: Join, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger with the request's items added to what is held, and the changes."""
    faults: list[Fault] = []
    start = ledger
    keys: list[ClaimKey] = []
    listed = set[Subject]()
    for item in request.demanded:
        with_claims = [*conflicts(item, start)]
        # an item that contradicts a claim and an item above is reported once for each field
        fields = {each.field for each in with_claims}
        above = conflicts(item, ledger, above=True) if item.held.subject in listed else ()
        faults += [*with_claims, *(each for each in above if each.field not in fields)]
        listed.add(item.held.subject)
        key = ClaimKey(item.held.subject, demand_id(request.id, item.requesters))
        # a put may have chosen this id for its demand, because demand ids are free text
        claims = start.claims_of_demand(key.demand)
        owners = {who for claim in claims for who in claim.requesters}
        if owners and owners.isdisjoint(item.requesters):
            message = (
                f"gives the demand id {key.demand}, which belongs to a demand of "
                f"{', '.join(sorted(owners))}; use another id"
            )
            faults.append(fault("id", message, code="conflict"))
        ledger = book(ledger, item, request.id, key, ledger.get(key), now, joined=True)
        keys.append(key)
    if faults:
        raise Refused(faults)
    changes = claim_changes(start, ledger, keys)
    if not changes:
        return start, Changes()
    # A join that only renews claims keeps the records of recent shutdowns. If it removed the record
    # of a shutdown, a repeat of this shutdown would count as a new one and end another demand.
    adds = not all(change.only_renews for change in changes)
    shutdowns, forgotten = start.shutdowns.forget(now, request.requesters() if adds else ())
    return replace(ledger, shutdowns=shutdowns), Changes(claims=changes, shutdowns=forgotten)


# ---- a put: a demand with an id holds exactly the applications and connections that it lists ----


def put(ledger: Ledger, request: Put, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger in which the demand holds only what ``request`` lists, and the changes."""
    start, demand = ledger, request.demand
    held = ledger.claims_of_demand(demand)
    refuse_other_owners(held, request)
    waited = (demand,) * is_waiting(ledger, request)
    # the demand's own claims are no contradiction, because a put may move its own applications
    ledger = others = ledger.without(held)
    faults: list[Fault] = []
    keys = [claim.key for claim in held]
    for item in request.demanded:
        faults += conflicts(item, others)
        key = ClaimKey(item.held.subject, demand)
        if ledger.get(key) is not None:
            message = f"'{key.subject.id}' is listed twice; list it once, with all its topics"
            faults.append(item.fault("id", message))
        ledger = book(ledger, item, request.id, key, start.get(key), now)
        keys.append(key)
    if faults:
        raise Refused(faults)
    changes = Changes(claims=claim_changes(start, ledger, keys), waiting=waited)
    return ledger.without_waiting(waited), changes
