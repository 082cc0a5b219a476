"""A release ends a demand that has an id: the demand gives up everything that it holds."""

from __future__ import annotations

from demandops.demand.demand_request import Release
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.operations.ownership import is_waiting, owned_claims


def release_demand(ledger: Ledger, request: Release) -> tuple[Ledger, Changes]:
    """Return the ledger in which a demand holds nothing and does not wait, and the changes."""
    waited = (request.demand,) * is_waiting(ledger, request)
    held = ledger.claims_of_demand(request.demand) if waited else owned_claims(ledger, request)
    after = ledger.without(held).without_waiting(waited)
    claims = claim_changes(ledger, after, [claim.key for claim in held])
    return after, Changes(claims=claims, waiting=waited)
