"""The ledger's one operation: :func:`apply` books a request or releases what it holds.

As a whole or not at all, and it says what changed. Semantics: ``docs/architecture.md``, "Booking".
"""

from __future__ import annotations

from datetime import datetime

from generator.demand.request import DemandRequest, Operation
from generator.ledger.books import Changes, ClaimChange, Ledger
from generator.ledger.join import join
from generator.ledger.release import release

__all__ = ["Changes", "ClaimChange", "Ledger", "apply"]


def apply(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Book what ``request`` joins, or release what its shutdown lists.

    Args:
        ledger: what is booked.
        request: an admitted request (:mod:`generator.demand.admission`).
        now: when it was received, with time zone; kept in claims that change.

    Returns:
        The new ledger and what changed. Booking twice changes nothing.

    Raises:
        Refused: with every contradiction to a standing claim, or where a shutdown lists nothing
            that is held. Nothing is booked then.
    """
    if request.operation is Operation.SHUTDOWN:
        return release(ledger, request, now)
    return join(ledger, request, now)
