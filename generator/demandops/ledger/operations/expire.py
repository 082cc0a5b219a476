"""An expiry releases the claims whose lease has ended. The generator requests the expiry."""

from __future__ import annotations

from datetime import datetime

from demandops.demand.demand_request import Expire
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger


def expire(ledger: Ledger, request: Expire, now: datetime) -> tuple[Ledger, Changes]:
    held = ledger.claims_of_demand(request.demand)
    ended = [claim for claim in held if claim.lease and claim.lease.has_ended(now)]
    after = ledger.without(ended)
    return after, Changes(claims=claim_changes(ledger, after, [claim.key for claim in ended]))
