"""Decommissioning: a node or a requester leaves for good; its claims are released or reduced.

Decommissioning a node releases its applications, the inputs from it and the connections that end at
it, whoever requested them. Decommissioning a requester releases all its claims, also those that it
shares: it named the other requesters, who might never release them.
"""

from __future__ import annotations

from datetime import datetime

from demandops.demand.claim import Claim
from demandops.demand.demand_request import Decommission
from demandops.errors import Fault, Refused, fault, suggestion
from demandops.ledger.ledger import Changes, Ledger, claim_changes
from demandops.subject import Subject, SubjectKind


def decommission(ledger: Ledger, request: Decommission, now: datetime) -> tuple[Ledger, Changes]:
    """Release all claims of a node or a requester.

    Raises:
        Refused: if it holds nothing.
    """
    start, claims = ledger, dict[str, Claim]()
    if "node" in request.kinds:
        claims |= {f"{c.subject} {c.demand}": c for c in claims_needing(ledger, request.id)}
    if "requester" in request.kinds:
        held = ledger.claims_of_requester(request.id)
        claims |= {f"{c.subject} {c.demand}": c for c in held}
    for claim in claims.values():
        ledger = ledger.replace(claim.key, _reduced(claim, request))
    changes = claim_changes(start, ledger, [claim.key for claim in claims.values()])
    if not changes:
        raise Refused([_nothing_held(start, request)])
    return ledger, Changes(claims=changes)


def claims_needing(ledger: Ledger, node: str) -> list[Claim]:
    """Return the claims that need a node, in no order."""
    subjects = [Subject(SubjectKind.APPLICATION, id) for id in ledger.applications_at(node)]
    subjects += [Subject(SubjectKind.CONNECTION, id) for id in ledger.connections_needing(node)]
    return [
        claim
        for subject in subjects
        for claim in ledger.claims_on(subject)
        if claim.held.needs(node)
    ]


def _reduced(claim: Claim, request: Decommission) -> Claim | None:
    if "requester" in request.kinds and request.id in claim.requesters:
        return None
    return claim.without_node(request.id) if claim.held.needs(request.id) else claim


def _nothing_held(ledger: Ledger, request: Decommission) -> Fault:
    """Return the fault for a name without claims; it suggests a similar name."""
    names = [ledger.indexed_names("requester")] if "requester" in request.kinds else []
    names += (
        [ledger.indexed_names("node"), ledger.indexed_names("link")]
        if "node" in request.kinds
        else []
    )
    kinds = " or ".join(sorted(request.kinds))
    close = suggestion(request.id, {name for found in names for name in found})
    message = f"'{request.id}' holds nothing as a {kinds}{close}"
    return fault("name", message, code="not-held")
