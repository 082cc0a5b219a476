"""The ledger's one operation: :func:`apply` books a request, renews or releases what it holds.

As a whole or not at all, and it says what changed. Semantics: ``docs/architecture.md``, "Booking".
"""

from __future__ import annotations

from datetime import datetime

from demandops.demand.demand_request import DemandRequest, Operation
from demandops.ledger import named_demand
from demandops.ledger.decommission import decommission
from demandops.ledger.join import join
from demandops.ledger.ledger import Changes, Ledger
from demandops.ledger.restoration import restore
from demandops.ledger.shutdown import release


def apply(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Carry out what ``request`` asks: book, replace, renew, release.

    Args:
        ledger: what is booked.
        request: an admitted request (:mod:`demandops.demand.admission`).
        now: when it was received, with time zone; kept in claims that change.

    Returns:
        The new ledger and what changed. Booking twice changes nothing.

    Raises:
        Refused: with every contradiction to a standing claim, or where what is to be released or
            renewed is not held. Nothing is booked then.
    """
    match request.operation:
        case Operation.JOIN:
            return join(ledger, request, now)
        case Operation.SHUTDOWN:
            return release(ledger, request, now)
        case Operation.PUT:
            return named_demand.put(ledger, request, now)
        case Operation.RELEASE:
            return named_demand.release(ledger, request)
        case Operation.RENEW:
            return named_demand.renew(ledger, request, now)
        case Operation.EXPIRE:
            return named_demand.expire(ledger, request, now)
        case Operation.DECOMMISSION:
            return decommission(ledger, request, now)
        case Operation.ROLLBACK:
            return restore(ledger, request, now)
