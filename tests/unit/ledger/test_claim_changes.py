"""What a change of a claim says about itself, and which demands a refusal names."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import pytest
from demandops.base.errors import Refused
from demandops.connections.connection import Connection, Route
from demandops.connections.mqtt import MQTT
from demandops.decide.booking import apply
from demandops.model.demand.claim import OVERRIDE_PREFIX, Claim, ClaimKey, Term
from demandops.model.demand.demand_request import Demanded, DemandRequest, Join, Release, Shutdown
from demandops.model.ledger.ledger import Changes, Ledger

NOW = datetime(2026, 1, 31, 12, 0, tzinfo=timezone.utc)
HELD = Connection("c", MQTT, "s", "t", "", (Route("/a", "/b"),))


def item(*requesters: str) -> tuple[Demanded, ...]:
    return (Demanded(HELD, requesters, "connections[0].{}".format, Term(60)),)


def applied(ledger: Ledger, request: DemandRequest, minutes: int) -> tuple[Ledger, Changes]:
    return apply(ledger, request, NOW + timedelta(minutes=minutes))


def test_a_renewed_lease_only_renews_and_a_shutdown_does_not() -> None:
    ledger, new = applied(Ledger(), Join("r", item("v", "w")), 0)
    ledger, again = applied(ledger, Join("r", item("v", "w")), 1)
    _, less = applied(ledger, Shutdown("r", item("v")), 2)
    assert [change.only_renews for change in new.claims] == [False]
    assert [change.only_renews for change in again.claims] == [True]
    assert [change.only_renews for change in less.claims] == [False]


def test_a_refusal_suggests_no_claims_of_overrides() -> None:
    ledger = Ledger()
    for demand in (f"{OVERRIDE_PREFIX}keep", "mine"):
        claim = Claim(HELD, demand, "r", ("v",), NOW)
        ledger = ledger.replace(ClaimKey(HELD.subject, demand), claim)
    with pytest.raises(Refused) as refused:
        applied(ledger, Release("r", (), "mien", ("v",)), 0)
    assert refused.value.faults[0].message == (
        "'mien' holds nothing; the requesters of this request hold, for example, mine"
    )
