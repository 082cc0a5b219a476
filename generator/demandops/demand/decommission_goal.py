"""Decommissioning as plain data: a node or a requester that leaves for good.

The operator's request to the generator, no goal of a requester: neither action carries it, nor
does a file of demands. It is plain data all the same, so that the outbox keeps it like any demand.
"""

from __future__ import annotations

from typing import Any

from demandops.demand.demand_request import DecommissionTarget, DemandRequest, Operation
from demandops.errors import Fault, Refused, fault
from demandops.identifiers import id_problem

KIND = "Decommission"


def as_data(name: str, kinds: tuple[str, ...], by: str) -> dict[str, Any]:
    """Return a request to decommission ``name``.

    Args:
        name: the node or the requester.
        kinds: as what it leaves, ``node``, ``requester`` or both.
        by: who has it done, ``name <email>``; empty where that is not known.
    """
    return {"kind": KIND, "name": name, "as": list(kinds), "by": by}


def is_decommission(data: object) -> bool:
    """Tell whether plain data is a request to decommission something."""
    return isinstance(data, dict) and data.get("kind") == KIND


def parse(data: dict[str, Any]) -> DemandRequest:
    """Return the request.

    Raises:
        Refused: where the name is none.
    """
    name = data.get("name")
    problem = id_problem(name) if isinstance(name, str) else "must be text"
    faults: list[Fault] = [fault("name", problem)] if problem else []
    if faults:
        raise Refused(faults)
    kinds = frozenset(kind for kind in data.get("as", ()) if kind in ("node", "requester"))
    leaving = DecommissionTarget(str(name), kinds, str(data.get("by") or ""))
    return DemandRequest(
        id=str(name), operation=Operation.DECOMMISSION, decommission_target=leaving
    )
