"""A put: replaces the claims of a demand that names itself by what the request lists."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime

from demandops.demand.claim import Claim, ClaimKey, Subject, SubjectKind
from demandops.demand.demand_request import DemandRequest
from demandops.errors import Fault, Refused, fault
from demandops.ledger.ledger import Changes, Ledger, claim_changes
from demandops.ledger.operations.claim_from_demand import application_claim, connection_claim
from demandops.ledger.operations.conflicts import application_conflicts, connection_conflicts
from demandops.ledger.operations.ownership import refuse_other_owners


def put(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Book what ``request`` lists, and release everything else that the demand holds.

    Raises:
        Refused: if the demand belongs to other requesters or conflicts with other demands.
    """
    start, demand = ledger, request.demand
    held = ledger.claims_of_demand(demand)
    refuse_other_owners(held, request)
    # a demand does not contradict itself: it may move an application
    ledger = others = ledger.without(held)
    faults: list[Fault] = []
    keys = [claim.key for claim in held]
    for index, app in enumerate(request.applications):
        faults += application_conflicts(f"applications[{index}]", app, others)
        key = ClaimKey(Subject(SubjectKind.APPLICATION, app.id), demand)
        faults += _listed_twice(f"applications[{index}].id", key, ledger)
        claim: Claim = application_claim(app, request.id, demand, start.get(key), now)
        ledger = ledger.replace(key, claim)
        keys.append(key)
    for index, connection in enumerate(request.connections):
        faults += connection_conflicts(f"connections[{index}]", connection, others)
        key = ClaimKey(Subject(SubjectKind.CONNECTION, connection.id), demand)
        faults += _listed_twice(f"connections[{index}].id", key, ledger)
        claim = connection_claim(connection, request.id, demand, start.get(key), now)
        ledger = ledger.replace(key, claim)
        keys.append(key)
    if faults:
        raise Refused(faults)
    return ledger, Changes(claims=claim_changes(start, ledger, keys))


def _listed_twice(where: str, key: ClaimKey, ledger: Ledger) -> Iterator[Fault]:
    if ledger.get(key) is not None:
        yield fault(where, f"'{key.subject.id}' is listed twice; list it once, with all it takes")
