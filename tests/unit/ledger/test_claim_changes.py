"""What a change of claims says about itself, and which connections the ledger knows at a node.

``tests/scenarios/a-connection-carries-a-topic-in-one-way.yaml`` has the contradictions.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from typing import Any

import pytest
from demandops.base.errors import Refused
from demandops.connections.connection import Connection, Route
from demandops.connections.mqtt import MQTT
from demandops.decide.booking import apply
from demandops.model.demand.demand import UNSTARTED, Demand, Item, Lease
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger.claim import OVERRIDE_PREFIX, Claim
from demandops.model.ledger.ledger import Changes, Ledger

from tests.kit.goals import put
from tests.kit.memory import NOW, MemoryRepo, rebuilt

HELD = Connection("c", MQTT, "s", "t", "", (Route("/a", "/b"),))


def item(*requesters: str, held: Connection = HELD) -> tuple[Item, ...]:
    return (Item(held, requesters, lease=Lease(60)),)


def applied(ledger: Ledger, request: Demand, minutes: int = 0) -> tuple[Ledger, Changes]:
    return apply(ledger, request, NOW + timedelta(minutes=minutes))


def joined(ledger: Ledger, who: str = "v", **changed: Any) -> Ledger:
    return applied(ledger, Demand("join", "r", item(who, held=replace(HELD, **changed))))[0]


def test_a_renewed_lease_only_renews_and_a_shutdown_does_not() -> None:
    ledger, new = applied(Ledger(), Demand("join", "r", item("v", "w")), 0)
    ledger, again = applied(ledger, Demand("join", "r", item("v", "w")), 1)
    _, less = applied(ledger, Demand("shutdown", "r", item("v", "w")), 2)
    renews = [change.only_renews for changes in (new, again, less) for change in changes.claims]
    assert renews == [False, True, False]


def test_a_refusal_suggests_no_claims_of_overrides() -> None:
    demands = (f"{OVERRIDE_PREFIX}keep", "mine")
    ledger = rebuilt(Claim(HELD, demand, "r", ("v",), NOW) for demand in demands)
    with pytest.raises(Refused, match=r"hold, for example, mine$"):
        applied(ledger, Demand("release", "r", (), "mien", ("v",)))


def test_a_reverse_route_delivers_to_the_source() -> None:
    ledger = joined(Ledger(), topics=(Route("/a", "/b"), Route("/c", "/d", reverse=True)))
    assert ledger.ids_with("brings", "t", "/b")
    assert ledger.ids_with("brings", "s", "/c")
    assert not ledger.ids_with("brings", "t", "/d")


def test_a_proposed_lease_has_no_end_and_is_written_without() -> None:
    books = MemoryRepo()
    decision = books.decide(put("d", lease=60))
    ledger = books.decide(replace(decision.request, awaits_approval=True)).state.ledger
    claims = ledger.claims_with("demand", "d")
    claim = next(one for one in claims if one.is_on_application)
    assert claim.lease is not None
    assert claim.lease.until == UNSTARTED
    assert not claim.lease.has_started
    text = claim_files.text_of(claim)
    assert "until" not in text
    assert claim_files.read(text, claim_files.path_of(claim.key)) == claim
    assert {one.key for one in ledger.unstarted_claims()} == {one.key for one in claims}
    later = claim.lease.started(NOW)
    assert (later.seconds, (later.until - NOW).total_seconds()) == (60, 60)
    assert ledger.ended_claims(NOW.replace(year=2100)) == ()
