"""The release of a demand by its id."""

from __future__ import annotations

from demandops.demand.demand_request import Release
from demandops.ledger.ledger import Changes, Ledger, claim_changes
from demandops.ledger.operations.ownership import owned_claims


def release_demand(ledger: Ledger, request: Release) -> tuple[Ledger, Changes]:
    """Release all claims of a demand.

    Raises:
        Refused: if the demand holds nothing or belongs to other requesters.
    """
    held = owned_claims(ledger, request)
    after = ledger.without(held)
    return after, Changes(claims=claim_changes(ledger, after, [claim.key for claim in held]))
