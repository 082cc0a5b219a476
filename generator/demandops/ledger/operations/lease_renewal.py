"""The renewal of the leases of a demand."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

from demandops.demand.demand_request import Renew
from demandops.demand.lease import Term
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.operations.ownership import is_waiting, owned_claims


def renew_leases(ledger: Ledger, request: Renew, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger with each lease of a demand renewed for its term, and the changes."""
    # a demand that waits has no lease yet, but its client may renew it already
    if is_waiting(ledger, request) and not ledger.claims_of_demand(request.demand):
        return ledger, Changes()
    start = ledger
    held = owned_claims(ledger, request)
    for claim in held:
        if claim.lease is None:
            continue
        term = Term(claim.lease.seconds, claim.lease.slack)
        ledger = ledger.replace(claim.key, replace(claim, lease=claim.lease.renewed(term, now)))
    return ledger, Changes(claims=claim_changes(start, ledger, [claim.key for claim in held]))
