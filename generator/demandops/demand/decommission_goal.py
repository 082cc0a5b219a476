"""The request to decommission a node or a requester, as plain data.

Only the operator makes it; neither an action nor a demand file contains it. It is plain data so
that the journal can store it like a demand.
"""

from __future__ import annotations

from typing import Any

from demandops.demand.demand_request import Decommission
from demandops.errors import Fault, Refused, fault
from demandops.identifiers import id_problem

KIND = "Decommission"


def as_data(name: str, kinds: tuple[str, ...], by: str) -> dict[str, Any]:
    """Return a request to decommission ``name``.

    Args:
        name: the node or the requester.
        kinds: ``node``, ``requester`` or both.
        by: the operator, ``name <email>``; empty if unknown.
    """
    return {"kind": KIND, "name": name, "as": list(kinds), "by": by}


def is_decommission(data: object) -> bool:
    """Return whether plain data is a request to decommission."""
    return isinstance(data, dict) and data.get("kind") == KIND


def parse(data: dict[str, Any]) -> Decommission:
    """Return the request of plain data.

    Raises:
        Refused: if the name is invalid.
    """
    name = data.get("name")
    problem = id_problem(name) if isinstance(name, str) else "must be text"
    faults: list[Fault] = [fault("name", problem)] if problem else []
    if faults:
        raise Refused(faults)
    kinds = frozenset(kind for kind in data.get("as", ()) if kind in ("node", "requester"))
    return Decommission(id=str(name), kinds=kinds, by=str(data.get("by") or ""))
