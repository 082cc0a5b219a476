"""The owners of a demand that has an id: the requesters for whom it holds claims or waits.

A request is refused if it names none of the owners. So if a second requester chooses the same
demand id by chance, its requests cannot change the demand of the first requester.
"""

from __future__ import annotations

from collections.abc import Iterable

from demandops.demand.claim import Claim
from demandops.demand.demand_request import DemandRequest
from demandops.errors import Refused
from demandops.ledger.ledger import Ledger


def is_waiting(ledger: Ledger, request: DemandRequest) -> bool:
    """Return whether the request's demand waits; raise :class:`Refused` if it is of other
    requesters.
    """
    waiting = ledger.waiting.get(request.demand)
    if waiting is not None:
        _refuse_others(waiting.requesters, request)
    return waiting is not None


def owned_claims(ledger: Ledger, request: DemandRequest) -> tuple[Claim, ...]:
    """Return the claims of the demand; raise Refused if it holds none or is of others."""
    held = ledger.claims_of_demand(request.demand)
    if not held:
        demands = sorted(
            {
                claim.demand
                for requester in request.own_requesters
                for claim in ledger.claims_of_requester(requester)
                if claim.keeping_override is None
            }
        )
        hint = "the demand has ended, or was never booked; see 'demandops log'"
        if demands:
            hint = f"the requesters of this request hold, for example, {', '.join(demands[:5])}"
        message = f"'{request.demand}' holds nothing; {hint}"
        raise Refused.at("demand", message, code="not-held")
    refuse_other_owners(held, request)
    return held


def refuse_other_owners(held: Iterable[Claim], request: DemandRequest) -> None:
    """Raise :class:`Refused` if the claims belong to none of the request's requesters."""
    _refuse_others({requester for claim in held for requester in claim.requesters}, request)


def _refuse_others(owners: Iterable[str], request: DemandRequest) -> None:
    owners = sorted(owners)
    if owners and not set(owners) & set(request.requesters()):
        message = (
            f"'{request.demand}' is a demand of {', '.join(owners)}; name one of them, or choose "
            "another demand id"
        )
        raise Refused.at("demand", message, code="not-yours")
