"""A join: a goal of the reference's action adds to what its demand already holds."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

from demandops.demand.claim import ClaimKey, demand_id
from demandops.demand.demand_request import Join
from demandops.errors import Fault, Refused, fault
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.operations.booking import book
from demandops.ledger.operations.conflicts import conflicts
from demandops.subject import Subject


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
