"""A join: a goal of the reference's action adds to what its demand already holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime

from demandops.demand.claim import ClaimKey, demand_id
from demandops.demand.demand_request import Demanded, Join
from demandops.errors import Fault, Refused, fault
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.operations.booking import book
from demandops.ledger.operations.conflicts import conflicts
from demandops.subject import Subject


def join(ledger: Ledger, request: Join, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger with the request's items added to what its demand holds, and the changes.

    Raises:
        Refused: with every conflict with an existing claim, or between items of the request, or if
            the demand's id, which is a digest, is that of another demand.
    """
    faults: list[Fault] = []
    start = ledger
    keys: list[ClaimKey] = []
    listed = set[Subject]()
    for one in request.demanded:
        found = [*conflicts(one, start)]
        known = {each.field for each in found}
        above = conflicts(one, ledger, above=True) if one.held.subject in listed else ()
        faults += [*found, *(each for each in above if each.field not in known)]
        listed.add(one.held.subject)
        key = ClaimKey(one.held.subject, demand_id(request.id, one.requesters))
        faults += _of_another_demand(one, request, key.demand, start)
        ledger = book(ledger, one, request.id, key, ledger.get(key), now, joined=True)
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


def _of_another_demand(
    one: Demanded, request: Join, demand: str, ledger: Ledger
) -> Iterator[Fault]:
    owners = {who for claim in ledger.claims_of_demand(demand) for who in claim.requesters}
    if owners and owners.isdisjoint(one.requesters):
        message = f"gives the demand id {demand}, which belongs to a demand of "
        message += f"{', '.join(sorted(owners))}; use another id"
        yield fault("id", message, code="conflict")
