"""Decommissioning: what remains of the claims when a node or a requester leaves for good.

With a node goes what cannot be without it: the applications at it, the inputs that come from it,
the connections that end at it; in whosever name. With a requester go the claims in its name, as by
a shutdown: a claim stands in the name of all its requesters together, and what is left in those of
the others alone nobody would ever give up.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from types import MappingProxyType

from demandops.demand.claim import ApplicationClaim, Claim, ConnectionClaim, Subject, SubjectKind
from demandops.demand.demand_request import DecommissionTarget, DemandRequest
from demandops.errors import Fault, Refused, fault, suggestion
from demandops.ledger.ledger import Changes, Ledger, differences


def decommission(ledger: Ledger, request: DemandRequest, now: datetime) -> tuple[Ledger, Changes]:
    """Release all that a node or a requester holds.

    Raises:
        Refused: where it holds nothing.
    """
    leaving = request.decommission_target
    assert leaving is not None  # noqa: S101 - a request to decommission says what
    start, claims = ledger, dict[str, Claim]()
    if "node" in leaving.kinds:
        claims |= {f"{c.subject} {c.demand}": c for c in claims_at(ledger, leaving.name)}
    if "requester" in leaving.kinds:
        held = ledger.of_requester(leaving.name)
        claims |= {f"{c.subject} {c.demand}": c for c in held}
    for claim in claims.values():
        ledger = ledger.replace(claim.key, _left_of(claim, leaving, now))
    changes = differences(start, ledger, [claim.key for claim in claims.values()])
    if not changes:
        raise Refused([_nothing_held(start, leaving)])
    return ledger, Changes(claims=changes)


def claims_at(ledger: Ledger, node: str) -> list[Claim]:
    """Return the claims that need a node, in no order."""
    subjects = [Subject(SubjectKind.APPLICATION, id) for id in ledger.at_node(node)]
    subjects += [Subject(SubjectKind.CONNECTION, id) for id in ledger.connected(node)]
    return [claim for subject in subjects for claim in ledger.of(subject) if needs(claim, node)]


def needs(claim: Claim, node: str) -> bool:
    """Tell whether a claim cannot stand as it is without a node."""
    if isinstance(claim, ApplicationClaim):
        return claim.node == node or any(t.source == node for _, t in claim.all_inputs())
    return node in (claim.source, claim.target, claim.broker)


def _left_of(claim: Claim, leaving: DecommissionTarget, now: datetime) -> Claim | None:
    if "requester" in leaving.kinds and leaving.name in claim.requesters:
        return None
    return _without_node(claim, leaving.name, now) if needs(claim, leaving.name) else claim


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
    """Say that nothing is held, with a name that comes near: a typo must show."""
    names = [ledger.names("requester")] if "requester" in leaving.kinds else []
    names += [ledger.names("node"), ledger.names("link")] if "node" in leaving.kinds else []
    kinds = " or ".join(sorted(leaving.kinds))
    close = suggestion(leaving.name, {name for found in names for name in found})
    message = f"'{leaving.name}' holds nothing as a {kinds}{close}"
    return fault("name", message, code="not-held")
