"""A shutdown releases the claims that it matches, or parts of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime

from demandops.demand.claim import Claim, ClaimKey, demand_id
from demandops.demand.demand_request import Demanded, Shutdown
from demandops.errors import Fault, Refused, fault
from demandops.ledger.ledger import Changes, Ledger, claim_changes


def shut_down(ledger: Ledger, request: Shutdown, now: datetime) -> tuple[Ledger, Changes]:
    """Release the applications, connections and topics that a shutdown lists.

    Raises:
        Refused: if the requesters hold none of them.
    """
    start = ledger
    keys: list[ClaimKey] = []
    not_held: list[str] = []
    for one in request.demanded:
        subject = one.held.subject
        # look in ``start``: a subject that is listed twice means the same claim both times
        claim = _matching_claim(start.claims_on(subject), request.id, one)
        if claim is None:
            not_held.append(f"{subject} for {', '.join(one.requesters)}")
            continue
        not_held += [f"{subject}: {name}" for name in _subtract(claim, one, now)[1]]
        left = ledger.get(claim.key)
        if left is not None:
            ledger = ledger.replace(claim.key, _subtract(left, one, now)[0])
        keys.append(claim.key)
    changes = claim_changes(start, ledger, keys)
    if not changes:
        raise Refused([_nothing_held(start, request)])
    return ledger, Changes(claims=changes, not_held=tuple(dict.fromkeys(not_held)))


def _matching_claim(claims: Iterable[Claim], request: str, listed: Demanded) -> Claim | None:
    """Return the claim that a shutdown matches, or ``None`` if none or several could match."""
    claims = [claim for claim in claims if claim.held.is_meant_by(listed.held)]
    requesters = set(listed.requesters)
    own_id = demand_id(request, requesters)
    exact = [claim for claim in claims if set(claim.requesters) == requesters]
    meant = (
        [claim for claim in exact if claim.demand == own_id]
        or [claim for claim in exact if claim.request == request]
        or exact
        or [claim for claim in claims if set(claim.requesters) >= requesters]
    )
    return meant[0] if len(meant) == 1 else None


def _subtract(claim: Claim, one: Demanded, now: datetime) -> tuple[Claim | None, list[str]]:
    """Return the rest of a claim, ``None`` if nothing is left, and topics that it did not hold."""
    held = claim.held
    left, missing = held.without(one.held)  # type: ignore[arg-type]  # it is of the same kind
    if left is None or left == held:
        return (None if left is None else claim), missing
    return replace(claim, held=left, booked=now), missing


def _nothing_held(ledger: Ledger, request: Shutdown) -> Fault:
    """Return the fault for a shutdown that matches no claim; it suggests similar claims."""
    near = [
        f"{claim.subject} for {', '.join(claim.requesters)} (request '{claim.request}')"
        for subject in request.subjects()
        for claim in ledger.claims_on(subject)
    ] or [
        f"{claim.subject} for {', '.join(claim.requesters)}"
        for requester in sorted(request.requesters())
        for claim in ledger.claims_of_requester(requester)
    ]
    shown = "; ".join(dict.fromkeys(near[:5])) or "none"
    message = f"nothing that the shutdown lists is held; similar claims: {shown}"
    if not request.demanded:
        return fault("id", message, code="not-held")
    return request.demanded[0].fault("id", message, code="not-held")
