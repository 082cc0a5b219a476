"""A drain moves placed applications and services, with their connections, off a drained node.

The generator requests the drain. :mod:`demandops.plan.nodes.relocation` determines which claims
change.
"""

from __future__ import annotations

from dataclasses import dataclass

from demandops.demand.demand_request import DemandRequest
from demandops.ledger.claim_changes import Changes, ClaimChange, claim_changes
from demandops.ledger.ledger import Ledger


@dataclass(frozen=True, slots=True)
class Drain(DemandRequest):
    """The generator's request to move what it placed on the drained node ``id``.

    ``moved`` and ``stays`` have a text about each application or service that moves or cannot move.
    """

    # One drain looks only for so many nodes, because demands wait meanwhile. It begins with the
    # application that follows ``after`` in the order of ids. If some are left for another drain,
    # ``last`` is the last one before them.
    after: str = ""
    last: str = ""
    moves: tuple[ClaimChange, ...] = ()
    moved: tuple[str, ...] = ()
    stays: tuple[str, ...] = ()

    operation = "drain"


def drain(ledger: Ledger, request: Drain) -> tuple[Ledger, Changes]:
    start = ledger
    for move in request.moves:
        ledger = ledger.replace(move.key, move.after)
    return ledger, Changes(claims=claim_changes(start, ledger, [m.key for m in request.moves]))
