"""One connection carries a route, also after an upgrade, an edit by hand and a restoration.

``test_flows`` and ``tests/unit/ledger/test_properties.py`` hold it for demands.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from demandops.connections.connection import Connection
from demandops.decide.booking import Restoration
from demandops.decide.carriers import with_one_carrier
from demandops.decide.edits import faults_of_edit
from demandops.model.ledger.claim import Claim, path_of
from demandops.model.ledger.ledger import ClaimChange, ledger_of

from tests.kit.memory import MemoryRepo


def listing(demand: str, id: str, *topics: dict[str, Any]) -> dict[str, Any]:
    ends = {"id": id, "source": "vehicle00", "target": "edge", "topics": list(topics)}
    return {"kind": "Demand", "demand": demand, "requesters": [demand], "connections": [ends]}


def doubled() -> list[Claim]:
    """Return the claims of two demands that list one route, as each would hold it alone."""
    late = listing("late", "new", {"source": "/a", "qos": 1}, {"source": "/b"})
    claims = []
    for hour, goal in ((11, late), (9, listing("early", "old", {"source": "/a"}))):
        repo = MemoryRepo()
        repo.send(goal, repo.now.replace(hour=hour))
        claims += list(repo.state.ledger)
    return claims


def test_an_upgrade_gives_a_route_to_the_oldest_connection_that_has_it() -> None:
    ledger, keys = with_one_carrier(ledger_of(doubled()))
    held = {
        (claim.subject.id, claim.demand): [(r.source, r.qos, r.listed) for r in claim.held.topics]
        for claim in ledger
        if isinstance(claim.held, Connection)
    }
    assert held == {
        ("old", "early"): [("/a", 0, "")],
        ("old", "late"): [("/a", 0, "new")],
        ("new", "late"): [("/b", 0, "")],
    }
    assert {key.subject.id for key in keys} == {"old", "new"}
    assert with_one_carrier(ledger) == (ledger, [])


def test_a_claim_by_hand_that_doubles_a_route_is_invalid_and_a_restored_one_is_united() -> None:
    late, early = doubled()
    repo = MemoryRepo()
    before = replace(repo.state, ledger=ledger_of([early]))
    after = replace(repo.state, ledger=ledger_of([early, late]))
    (found,) = faults_of_edit(before, after, [ClaimChange(None, late)])
    assert (found.file, found.field) == (path_of(late.key), "topics[0]")
    assert "connection 'old' carries this topic" in found.message
    repo.send(Restoration(id="rollback", claims=(late, early)))
    carried = {
        (claim.subject.id, route.source)
        for claim in repo.state.ledger
        for route in claim.connection.topics
    }
    assert carried == {("old", "/a"), ("new", "/b")}
