"""The renewal of a demand's leases."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

from demandops.demand.demand_request import Renew
from demandops.demand.lease import Term
from demandops.ledger.ledger import Changes, Ledger, claim_changes
from demandops.ledger.operations.ownership import owned_claims


def renew_leases(ledger: Ledger, request: Renew, now: datetime) -> tuple[Ledger, Changes]:
    """Renew each lease of a demand for its own term; claims without a lease stay as they are.

    Raises:
        Refused: if the demand holds nothing or belongs to other requesters.
    """
    start = ledger
    held = owned_claims(ledger, request)
    for claim in held:
        if claim.lease is None:
            continue
        term = Term(claim.lease.seconds, claim.lease.slack)
        ledger = ledger.replace(claim.key, replace(claim, lease=claim.lease.renewed(term, now)))
    return ledger, Changes(claims=claim_changes(start, ledger, [claim.key for claim in held]))
