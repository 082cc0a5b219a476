"""Decommissioning: what remains of the claims when a node or a requester leaves for good.

For a node, its applications, the inputs from it and the connections that end at it are released,
even if others requested them. For a requester, all its claims are released, as by a shutdown. That
includes shared claims: if they stayed for the other requesters alone, nobody would release them.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from types import MappingProxyType

from demandops.demand.claim import ApplicationClaim, Claim, ConnectionClaim, Subject, SubjectKind
from demandops.demand.demand_request import DecommissionTarget, DemandRequest
from demandops.errors import Fault, Refused, fault, suggestion
from demandops.ledger.ledger import Changes, Ledger, claim_changes


def decommission(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Release all that a node or a requester holds.

    Raises:
        Refused: if it holds nothing.
    """
    leaving = request.decommission_target
    assert leaving is not None  # noqa: S101 - a decommission request names it
    start, claims = ledger, dict[str, Claim]()
    if "node" in leaving.kinds:
        claims |= {f"{c.subject} {c.demand}": c for c in claims_needing(ledger, leaving.name)}
    if "requester" in leaving.kinds:
        held = ledger.claims_of_requester(leaving.name)
        claims |= {f"{c.subject} {c.demand}": c for c in held}
    for claim in claims.values():
        ledger = ledger.replace(claim.key, _reduced(claim, leaving, now))
    changes = claim_changes(start, ledger, [claim.key for claim in claims.values()])
    if not changes:
        raise Refused([_nothing_held(start, leaving)])
    return ledger, Changes(claims=changes)


def claims_needing(ledger: Ledger, node: str) -> list[Claim]:
    """Return the claims that need a node, in no order."""
    subjects = [Subject(SubjectKind.APPLICATION, id) for id in ledger.applications_at(node)]
    subjects += [Subject(SubjectKind.CONNECTION, id) for id in ledger.connections_needing(node)]
    return [
        claim
        for subject in subjects
        for claim in ledger.claims_on(subject)
        if needs_node(claim, node)
    ]


def needs_node(claim: Claim, node: str) -> bool:
    """Return whether a claim depends on a node."""
    if isinstance(claim, ApplicationClaim):
        return claim.node == node or any(t.source == node for _, t in claim.all_inputs())
    return node in (claim.source, claim.target, claim.broker)


def _reduced(claim: Claim, leaving: DecommissionTarget, now: datetime) -> Claim | None:
    if "requester" in leaving.kinds and leaving.name in claim.requesters:
        return None
    return _without_node(claim, leaving.name, now) if needs_node(claim, leaving.name) else claim


def _without_node(claim: Claim, node: str, now: datetime) -> Claim | None:
    if isinstance(claim, ConnectionClaim):
        if node in (claim.source, claim.target):
            return None
        return replace(claim, broker="", booked=now)  # another broker may do
    if claim.node == node:
        return None
    inputs = {
        role: tuple(topic for topic in topics if topic.source != node)
        for role, topics in claim.inputs.items()
    }
    inputs = {role: topics for role, topics in inputs.items() if topics}
    return replace(claim, inputs=MappingProxyType(inputs), booked=now) if inputs else None


def _nothing_held(ledger: Ledger, leaving: DecommissionTarget) -> Fault:
    """Return the fault for a name without claims; it suggests a similar name."""
    names = [ledger.indexed_names("requester")] if "requester" in leaving.kinds else []
    names += (
        [ledger.indexed_names("node"), ledger.indexed_names("link")]
        if "node" in leaving.kinds
        else []
    )
    kinds = " or ".join(sorted(leaving.kinds))
    close = suggestion(leaving.name, {name for found in names for name in found})
    message = f"'{leaving.name}' holds nothing as a {kinds}{close}"
    return fault("name", message, code="not-held")
