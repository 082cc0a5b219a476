"""The booking of one demanded application or connection."""

from __future__ import annotations

from datetime import datetime

from demandops.demand.claim import Claim, ClaimKey
from demandops.demand.demand_request import Demanded
from demandops.demand.lease import renewed
from demandops.ledger.ledger import Ledger


def book(
    ledger: Ledger,
    item: Demanded,
    request: str,
    key: ClaimKey,
    current: Claim | None,
    now: datetime,
    *,
    joined: bool = False,
) -> Ledger:
    """Return the ledger with a claim on a demanded application or connection.

    ``current`` is the demand's claim on the same subject so far. A join keeps what it holds.
    """
    claim = Claim(
        held=item.held.booked(),
        demand=key.demand,
        request=request,
        requesters=tuple(sorted(set(item.requesters))),
        booked=now,
        lease=renewed(current.lease if current else None, item.term, now),
        joined=joined,
    )
    if joined and current:
        claim = claim.extending(current)
    return ledger.replace(key, claim.after_booking(current))
