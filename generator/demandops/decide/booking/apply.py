"""The one way to change the ledger: :func:`apply` carries out a request.

``docs/demand.md``, "How a demand is booked", says what each operation means.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

from demandops.decide.booking.joining import join, put
from demandops.decide.booking.leaving import (
    Drain,
    decommission,
    drain,
    expire,
    release_demand,
    renew_leases,
    shut_down,
)
from demandops.decide.booking.restoration import Restoration, restore
from demandops.model.demand.demand_request import (
    Decommission,
    DemandRequest,
    Expire,
    Join,
    Put,
    Release,
    Renew,
    Shutdown,
)
from demandops.model.ledger.ledger import Changes, Ledger
from demandops.model.ledger.records import Wait


def apply(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger after an admitted request is carried out, and the changes.

    If the same request is booked already, at most the leases of its claims change. ``now`` is when
    the request was received, with time zone.

    Raises:
        Refused: if the request contradicts existing claims or itself, changes a demand of other
            requesters, releases or renews what is not held, or undoes newer claims unasked.
    """
    match request:
        case Join():
            return join(ledger, request, now)
        case Shutdown():
            return shut_down(ledger, request, now)
        case Put():
            return put(ledger, request, now)
        case Release():
            return release_demand(ledger, request)
        case Renew():
            return renew_leases(ledger, request, now)
        case Expire():
            return expire(ledger, request, now)
        case Decommission():
            return decommission(ledger, request, now)
        case Wait():
            assert request.waiting is not None  # noqa: S101 - the decision sets it
            waiting = ledger.waiting.insert(request.demand, request.waiting)
            is_new = ledger.waiting.get(request.demand) != request.waiting
            changes = Changes(waiting=(request.demand,) * is_new)
            return replace(ledger, waiting=waiting), changes
        case Drain():
            return drain(ledger, request)
        case Restoration():
            return restore(ledger, request, now)
    raise TypeError(f"{type(request).__name__} cannot be applied")
