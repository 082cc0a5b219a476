"""The ledger's one operation: :func:`apply` books a request, renews or releases what it holds.

As a whole or not at all, and it says what changed. Semantics: ``docs/architecture.md``, "Booking".
"""

from __future__ import annotations

from datetime import datetime

from generator.demand.request import DemandRequest, Operation
from generator.ledger import named
from generator.ledger.books import Changes, ClaimChange, Ledger
from generator.ledger.decommission import decommission
from generator.ledger.join import join
from generator.ledger.release import release
from generator.ledger.restore import restore

__all__ = ["Changes", "ClaimChange", "Ledger", "apply"]


def apply(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Carry out what ``request`` asks: book, replace, renew, release.

    Args:
        ledger: what is booked.
        request: an admitted request (:mod:`generator.demand.admission`).
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
            return named.put(ledger, request, now)
        case Operation.RELEASE:
            return named.release(ledger, request)
        case Operation.RENEW:
            return named.renew(ledger, request, now)
        case Operation.EXPIRE:
            return named.expire(ledger, request, now)
        case Operation.DECOMMISSION:
            return decommission(ledger, request, now)
        case Operation.ROLLBACK:
            return restore(ledger, request, now)
