"""Demands for connections with all that a route can say, in short form.

``topics`` as the ledger writes them, ``type`` by name; becomes a document of the kind ``Demand``.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from demandops import decision
from demandops.decision import State
from demandops.render.changes.changeset import Changeset, FileReader


def document(demand: Mapping[str, Any]) -> dict[str, Any]:
    """Return the demand that holds just these connections, in the name of the first's."""
    connections = []
    for item in demand["connections"]:
        topics = [
            {"source": source, **({"target": said} if isinstance(said, str) else said)}
            for source, said in item.get("topics", {}).items()
        ]
        kept = {name: value for name, value in item.items() if name != "requesters"}
        connections.append(kept | {"topics": topics})
    ids = ", ".join(item["id"] for item in demand["connections"])
    requesters = demand["connections"][0].get("requesters", ["vehicle00"])
    head = {
        "kind": "Demand",
        "demand": f"{demand.get('id', 'request')} of {' '.join(requesters)}: {ids}",
        "requesters": requesters,
    }
    if demand.get("shutdown"):
        return head | {"operation": "release"}
    return head | {"connections": connections}


def decide(
    state: State, demand: Mapping[str, Any], now: datetime, read: FileReader
) -> tuple[State, Changeset]:
    """Judge a demand; raises :class:`Refused`."""
    made = decision.decide(state, document(demand), now, read)
    return made.state, Changeset(made.files, made.releases)
