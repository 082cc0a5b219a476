"""The lease clock decides which leases have ended, even after the machine's clock was set."""

from __future__ import annotations

import logging
from dataclasses import replace
from datetime import timedelta

import pytest
from demandops.connections.connection import Connection, Route
from demandops.connections.mqtt import MQTT
from demandops.model.demand.claim import Claim, Lease
from demandops.model.ledger.ledger import Ledger
from demandops.serve.timing.expiry import LeaseExpiry

from tests.kit.clock import Clock
from tests.kit.memory import NOW as START
from tests.kit.memory import rebuilt


def leased(*terms: tuple[str, int, int]) -> Ledger:
    """Return a ledger with a claim for each (demand, lease seconds, slack), booked at `START`."""
    claims = []
    for number, (demand, seconds, slack) in enumerate(terms):
        link = Connection(f"{number}", MQTT, "vehicle00", "edge", "", (Route("/a", "/a"),))
        lease = Lease(seconds, slack, START + timedelta(seconds=seconds))
        claims.append(Claim(link, demand, demand, ("a",), START, lease))
    return rebuilt(claims)


@pytest.fixture
def clocks() -> Clock:
    return Clock(START)


@pytest.fixture
def clock(clocks: Clock) -> LeaseExpiry:
    return LeaseExpiry(clocks)


def ended(clock: LeaseExpiry, ledger: Ledger) -> list[str]:
    return [claim.demand for claim in clock.ended_claims(ledger)[1]]


@pytest.mark.parametrize("steps", [[3600], [40, 40, 3600], [3600, -3600, 3600]])
def test_it_is_set_forward_and_a_full_term_is_granted(
    clocks: Clock, clock: LeaseExpiry, steps: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    ledger = leased(("short", 60, 5), ("long", 600, 5))
    for step in steps:
        clocks.set_by(step)
        assert ended(clock, ledger) == []
    assert "the clock jumped forward by 3600 s, so leases get their full term" in caplog.text
    for seconds, over in ((65, []), (1, ["short"]), (539, ["short"]), (1, ["short", "long"])):
        clocks.pass_(seconds)
        assert ended(clock, ledger) == over


def test_a_step_that_nobody_looked_at_is_noticed_later(clocks: Clock, clock: LeaseExpiry) -> None:
    ledger = leased(("a", 60, 0))
    clocks.pass_(50)
    clocks.set_by(3600)
    clocks.pass_(50)
    assert ended(clock, ledger) == []
    clocks.pass_(61)
    assert ended(clock, ledger) == ["a"]


def test_small_adjustments_of_the_clock_count_as_no_step(
    clocks: Clock, clock: LeaseExpiry, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    ledger = leased(("a", 60, 0))
    for _ in range(31):
        clocks.pass_(1)
        clocks.set_by(1)
        clock.seconds_until_due(ledger, 60.0)
    assert ended(clock, ledger) == ["a"]
    assert caplog.text == ""


def test_it_looks_again_when_the_first_lease_ends(clocks: Clock, clock: LeaseExpiry) -> None:
    ledger = leased(("a", 20, 10), ("b", 600, 0))
    assert clock.seconds_until_due(ledger, 60.0) == pytest.approx(30.01)
    clocks.pass_(29.5)
    assert clock.seconds_until_due(ledger, 60.0) == 1.0
    clocks.pass_(100)
    assert clock.seconds_until_due(ledger, 60.0) == 1.0, "it must not keep the clock busy"
    assert clock.seconds_until_due(Ledger(), 60.0) == 60.0
    assert clock.seconds_until_due(leased(("b", 86_400, 0)), 60.0) == 60.0


def test_an_end_that_moves_within_its_minute_is_seen(clock: LeaseExpiry) -> None:
    ledger = leased(("a", 50, 0), ("b", 55, 0))
    assert clock.seconds_until_due(ledger, 60) == pytest.approx(50, abs=0.1)
    (claim,) = ledger.claims_of_demand("b")
    sooner = replace(claim, lease=Lease(20, 0, START + timedelta(seconds=20)))
    ledger = ledger.replace(claim.key, sooner)
    assert clock.seconds_until_due(ledger, 60) == pytest.approx(20, abs=0.1)
