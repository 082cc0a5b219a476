"""A put: a demand with an id holds exactly the applications and connections that it lists."""

from __future__ import annotations

from datetime import datetime

from demandops.demand.claim import ClaimKey
from demandops.demand.demand_request import Put
from demandops.errors import Fault, Refused
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.operations.booking import book
from demandops.ledger.operations.conflicts import conflicts
from demandops.ledger.operations.ownership import is_waiting, refuse_other_owners


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
