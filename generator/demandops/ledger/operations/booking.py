"""The booking of one demanded application or connection."""

from __future__ import annotations

from datetime import datetime

from demandops.demand.claim import Claim, ClaimKey
from demandops.demand.demand_request import Demanded
from demandops.demand.lease import renewed
from demandops.ledger.ledger import Ledger


def book(
    ledger: Ledger,
    one: Demanded,
    request: str,
    key: ClaimKey,
    current: Claim | None,
    now: datetime,
    *,
    joined: bool = False,
) -> Ledger:
    """Return the ledger with a claim on a demanded application or connection.

    Args:
        ledger: the claims.
        one: what to book.
        request: the id of the request.
        key: the key of the claim.
        current: the demand's claim on the same subject so far, or ``None``.
        now: when the request was received. A claim of which at most the lease changes keeps its
            booking time.
        joined: whether a join books the claim; a join also keeps what ``current`` holds.
    """
    claim = Claim(
        held=one.held.booked(),
        demand=key.demand,
        request=request,
        requesters=tuple(sorted(set(one.requesters))),
        booked=now,
        lease=renewed(current.lease if current else None, one.term, now),
        joined=joined,
    )
    if joined and current:
        claim = claim.extending(current)
    return ledger.replace(key, claim.after_booking(current))
