"""Decommissioning: a node or a requester leaves for good, so claims are released or reduced.

If a node is decommissioned, these are released for all requesters: the applications that run on the
node, the inputs from it, the deliveries to it, and the connections from or to it. A connection that
names the node's broker loses the broker. If a requester is decommissioned, all its claims are
released. These include claims that also name other requesters, because the others might never
release the claims.
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime

from demandops.demand.claim import Claim
from demandops.demand.demand_request import Decommission
from demandops.errors import Fault, Refused, fault, suggestion
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.ledger.waiting import of_requester
from demandops.subject import Subject, SubjectKind


def decommission(ledger: Ledger, request: Decommission, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger after a node or requester is decommissioned, and the changes.

    If a requester is decommissioned, waiting demands that have no other requester are removed.

    Raises:
        Refused: if there is no claim to release or reduce, and no waiting demand to remove.
    """
    start, claims, waiting = ledger, dict[str, Claim](), tuple[str, ...]()
    nodes = request.nodes or (request.id,)
    if "node" in request.kinds:
        needing = (c for node in nodes for c in claims_needing(ledger, node))
        claims |= {f"{c.subject} {c.demand}": c for c in needing}
    if "requester" in request.kinds:
        held = ledger.claims_of_requester(request.id)
        claims |= {f"{c.subject} {c.demand}": c for c in held}
        waiting = tuple(one.demand for one in of_requester(ledger.waiting, request.id))
    for claim in claims.values():
        ledger = ledger.replace(claim.key, _reduced(claim, request, nodes))
    changes = claim_changes(start, ledger, [claim.key for claim in claims.values()])
    if not changes and not waiting:
        raise Refused([_nothing_held(start, request)])
    return ledger.without_waiting(waiting), Changes(claims=changes, waiting=waiting)


def claims_needing(ledger: Ledger, node: str) -> list[Claim]:
    """Return the claims on applications and connections that need a node, in no order."""
    subjects = [Subject(SubjectKind.APPLICATION, id) for id in ledger.applications_at(node)]
    subjects += [Subject(SubjectKind.CONNECTION, id) for id in ledger.connections_needing(node)]
    return [
        claim
        for subject in subjects
        for claim in ledger.claims_on(subject)
        if claim.held.needs(node)
    ]


def _reduced(claim: Claim, request: Decommission, nodes: Iterable[str]) -> Claim | None:
    if "requester" in request.kinds and request.id in claim.requesters:
        return None
    left: Claim | None = claim
    for node in nodes:
        left = left.without_node(node) if left and left.held.needs(node) else left
    return left


def _nothing_held(ledger: Ledger, request: Decommission) -> Fault:
    names = [ledger.indexed_names("requester")] if "requester" in request.kinds else []
    names += (
        [ledger.indexed_names("node"), ledger.indexed_names("link")]
        if "node" in request.kinds
        else []
    )
    kinds = " or ".join(sorted(request.kinds))
    close = suggestion(request.id, {name for found in names for name in found})
    message = f"no claim names a {kinds} '{request.id}'{close}"
    return fault("name", message, code="not-held")
