"""Decommissioning: a node or a requester leaves for good, so claims are released or reduced.

If a node is decommissioned, these are released for all requesters: the applications that run on the
node, the inputs from it, the deliveries to it, and the connections from or to it. A connection that
names the node's broker loses the broker. If a requester is decommissioned, all its claims are
released. These include claims that also name other requesters, because the others might never
release the claims.
"""

from __future__ import annotations

from datetime import datetime

from demandops.demand.claim import Claim
from demandops.demand.demand_request import Decommission
from demandops.errors import Refused, suggestion
from demandops.ledger.claim_changes import Changes, claim_changes
from demandops.ledger.ledger import Ledger
from demandops.subject import Subject, SubjectKind


def decommission(ledger: Ledger, request: Decommission, now: datetime) -> tuple[Ledger, Changes]:
    """Return the ledger after a node or requester is decommissioned, and the changes."""
    start, claims, waiting = ledger, dict[str, Claim](), tuple[str, ...]()
    nodes = request.nodes or (request.id,)
    if "node" in request.kinds:
        needing = (c for node in nodes for c in claims_needing(ledger, node))
        claims |= {f"{c.subject} {c.demand}": c for c in needing}
    if "requester" in request.kinds:
        held = ledger.claims_of_requester(request.id)
        claims |= {f"{c.subject} {c.demand}": c for c in held}
        # a waiting demand that names others too stays, because they can still release it
        demands = ledger.waiting.values()
        waiting = tuple(each.demand for each in demands if each.requesters == (request.id,))
    for claim in claims.values():
        left: Claim | None = claim
        if "requester" in request.kinds and request.id in claim.requesters:
            left = None
        for node in nodes:
            left = left.without_node(node) if left and left.held.needs(node) else left
        ledger = ledger.replace(claim.key, left)
    changes = claim_changes(start, ledger, [claim.key for claim in claims.values()])
    if not changes and not waiting:
        names = start.indexed_names("requester") if "requester" in request.kinds else set()
        if "node" in request.kinds:
            names |= start.indexed_names("node") | start.indexed_names("link")
        kinds = " or ".join(sorted(request.kinds))
        message = f"no claim names a {kinds} '{request.id}'{suggestion(request.id, names)}"
        raise Refused.at("name", message, code="not-held")
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
