"""The list of demands has the booked demands and the waiting demands, the oldest first."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

from demandops.model.ledger.records import WaitingDemand
from demandops.views.demand_lists import demands

from tests.kit.goals import perception
from tests.kit.memory import NOW, MemoryRepo


def test_a_demand_that_waits_is_listed_and_holds_nothing() -> None:
    repo = MemoryRepo()
    repo.send(perception())
    one = WaitingDemand("later", "r", ("vehicle01",), NOW + timedelta(days=1), 0, {})
    ledger = repo.state.ledger
    ledger = replace(ledger, waiting=ledger.waiting.insert("later", one))
    first, last = demands(replace(repo.state, ledger=ledger))
    assert (first.state, len(first.connections)) == ("held", 1)
    assert (last.name, last.state, last.applications) == ("later", "waiting", ())
