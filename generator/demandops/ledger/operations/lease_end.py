"""The end of a lease: the generator releases its claims."""

from __future__ import annotations

from datetime import datetime

from demandops.demand.demand_request import Expire
from demandops.ledger.ledger import Changes, Ledger, claim_changes


def release_ended(ledger: Ledger, request: Expire, now: datetime) -> tuple[Ledger, Changes]:
    """Release the claims of a demand whose lease has ended; none if it was renewed meanwhile."""
    held = ledger.claims_of_demand(request.demand)
    ended = [claim for claim in held if claim.lease is not None and claim.lease.expires_at < now]
    after = ledger.without(ended)
    return after, Changes(claims=claim_changes(ledger, after, [claim.key for claim in ended]))
