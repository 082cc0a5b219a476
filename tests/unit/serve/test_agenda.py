"""Pauses between tries, times of polls, demands in a minute, and which leases have ended."""

from __future__ import annotations

import logging
from contextlib import nullcontext
from dataclasses import replace
from datetime import timedelta
from itertools import count
from math import inf

import pytest
from demandops.base.runtime import REAL
from demandops.connections.connection import Connection, Route
from demandops.connections.mqtt import MQTT
from demandops.model.config.load import load
from demandops.model.demand.demand import Application, Demand, Item, Lease
from demandops.model.ledger.claim import Claim
from demandops.model.ledger.ledger import Ledger
from demandops.serve.agenda import (
    FIRST_TURN_S,
    LONGEST_AWAY_S,
    LONGEST_TURN_S,
    Agenda,
    Backoff,
    RateLimit,
    parse_interval,
)
from demandops.serve.demands import Remote

from tests.kit import plain_yaml
from tests.kit.clock import Clock
from tests.kit.config import configuration, edited, state_of
from tests.kit.memory import NOW, rebuilt


def test_waits_grow_to_their_bounds_and_never_beyond() -> None:
    pace = Backoff(200, REAL)
    away = [pace.unreachable() for _ in range(20)]
    assert max(away) <= LONGEST_AWAY_S
    assert min(away[-5:]) >= LONGEST_AWAY_S / 2
    turns = [pace.overtaken(10, 0.1, 1.0) for _ in range(20)]
    assert max(turns) <= LONGEST_TURN_S
    assert min(turns[-5:]) >= LONGEST_TURN_S / 2


def test_a_remote_that_answers_is_not_taken_to_be_away_and_success_begins_anew() -> None:
    pace = Backoff(200, REAL)
    for _ in range(10):
        pace.unreachable()
    pace.overtaken(10, 0.1, 1.0)
    assert pace.unreachable() <= FIRST_TURN_S
    for _ in range(10):
        pace.overtaken(10, 0.1, 1.0)
    pace.begin_anew()
    assert pace.overtaken(10, 0.1, 1.0) <= FIRST_TURN_S


def test_a_batch_takes_no_more_demands_than_are_evaluated_during_one_push() -> None:
    pace = Backoff(200, REAL)
    assert pace.max_demands == 200
    for demands, evaluating_s, most in ((100, 0.1, 100), (100, 1.0, 20), (2, 100.0, 1), (1, 0, 1)):
        pace.overtaken(demands, evaluating_s=evaluating_s, pushing_s=0.2)
        assert pace.max_demands == most
    pace.begin_anew()
    assert pace.max_demands == 200


EMPTY = state_of(load(configuration()))


@pytest.fixture
def clock() -> Clock:
    return Clock(NOW)


def fetch_in(agenda: Agenda) -> float:
    return agenda.due_in(EMPTY, "")["fetch"]


@pytest.mark.parametrize(("interval", "is_local", "reached", "pauses"), plain_yaml.beside(__file__))
def test_a_look_is_due_at_once_and_then_seldom_within_bounds_while_the_remote_is_away(
    clock: Clock, interval: float, is_local: bool, reached: list[bool], pauses: list[float]
) -> None:
    made = Agenda(interval, clock, local=is_local)
    for is_reached, pause in zip(reached, pauses, strict=True):
        assert fetch_in(made) == (0 if interval or pause < inf else inf), "a look is due"
        made.fetched(reached=is_reached)
        assert fetch_in(made) == pause
        clock.pass_(min(pause, 1e9))


def test_many_requests_give_one_poll_and_one_more_after_it(clock: Clock) -> None:
    made = Agenda(0, clock)
    assert fetch_in(made) == inf
    for _ in range(3):
        made.wants_fetch.set()
    assert fetch_in(made) == 0
    made.wants_fetch.clear()
    assert fetch_in(made) == inf
    made.wants_fetch.set()  # this comes during the poll, which may have missed its cause
    made.fetched(reached=True)
    assert fetch_in(made) == 0.5, "a burst of requests must not give one poll each"
    clock.pass_(0.5)
    assert fetch_in(made) == 0
    made.wants_fetch.clear()
    made.fetched(reached=True)
    assert fetch_in(made) == inf


def test_what_failed_waits_twice_as_long_each_time_up_to_a_minute(clock: Clock) -> None:
    made = Agenda(0, clock)
    for pause in (10, 20, 40, 60, 60):
        assert made.failed("drain", "edge", first=10) == made.waits_s("drain", "edge") == pause
        assert made.waits_s("drain", "cloud") == 0
        clock.pass_(pause)
        assert made.waits_s("drain", "edge") == 0
    clock.pass_(60)
    assert made.failed("drain", "edge", first=10) == 10, "it has not failed for a minute"


def test_by_chance_looks_come_earlier_and_never_later() -> None:
    made = Agenda(100, REAL)
    pauses = set()
    for _ in range(50):
        made.fetched(reached=True)
        pauses.add(fetch_in(made))
    assert len(pauses) > 10
    assert all(79 < pause <= 100 for pause in pauses)


TERMS = {"30s": 30, "1h30m": 5400, "0": 0, "0s": 0, "0.2": 0.2}


@pytest.mark.parametrize("text", [*TERMS, "", "-1", "often", "1e9", "30 s", "nan"])
def test_an_interval_is_a_duration_or_seconds(text: str) -> None:
    refused = pytest.raises(ValueError, match="is not a duration")
    with nullcontext() if text in TERMS else refused:
        assert parse_interval(text) == TERMS[text]


def test_away_and_back_are_logged_once_each(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="demandops")
    remote = Remote("https://git.example/state.git", clock)
    remote.record_reached()
    for _ in range(3):
        remote.record_failure("cannot be fetched: no route")
    assert remote.unreachable == "cannot be fetched: no route"
    clock.pass_(90)
    for _ in range(3):
        remote.record_reached(pushed=True)
    away, back = caplog.messages
    assert away.startswith("cannot be fetched: no route; trying again")
    assert back == "https://git.example/state.git is back after 90 s"
    assert not remote.unreachable and remote.last_push is not None


def test_a_push_that_is_denied_is_remembered_until_one_is_taken(clock: Clock) -> None:
    remote = Remote("somewhere", clock)
    remote.record_failure("takes no push: frozen", is_denied=True)
    remote.record_reached()
    assert (remote.push_denied, remote.unreachable) == ("takes no push: frozen", "")
    remote.record_reached(pushed=True)
    assert remote.push_denied == ""


def test_a_rate_limit_counts_a_hand_in_once_and_forgets_who_sends_no_more() -> None:
    quotas = "    quotas: {demandsPerMinute: 2}\n    namespace:"
    config = load(configuration(edited("policy/access-domains.yaml", "    namespace:", quotas)))
    throttle, names = RateLimit(), map(str, count())

    def allows(requester: str, at_s: float, operation: str = "") -> bool:
        app = Application("edge/fusion", "object-detection-fusion", "edge", inputs={})
        request = Demand("join", "one", (Item(app, (requester,)),))
        moment, name = NOW + timedelta(seconds=at_s), operation or next(names)
        return not list(throttle.faults(request, config, name, moment))

    assert [allows("a", 0, "judged again") for _ in range(5)] == [True] * 5
    assert (allows("a", 1), allows("a", 2)) == (True, False)
    for number in range(500):
        assert allows(f"vehicle{number}", 10 + number)
    assert len(throttle._seen) <= 62
    assert (allows("vehicle499", 509.5), allows("vehicle499", 509.6)) == (True, False)


def leased(*terms: tuple[str, int, int]) -> Ledger:
    """Return a ledger with a claim for each (demand, lease seconds, slack), booked at `NOW`."""
    claims = []
    for number, (demand, seconds, slack) in enumerate(terms):
        link = Connection(f"{number}", MQTT, "vehicle00", "edge", "", (Route("/a", "/a"),))
        lease = Lease(seconds, slack, NOW + timedelta(seconds=seconds))
        claims.append(Claim(link, demand, demand, ("a",), NOW, lease))
    return rebuilt(claims)


@pytest.fixture
def expiry(clock: Clock) -> Agenda:
    return Agenda(0, clock)


def leases_in(expiry: Agenda, ledger: Ledger) -> float:
    return expiry.due_in(replace(EMPTY, ledger=ledger), "")["leases"]


def ended(expiry: Agenda, ledger: Ledger) -> list[str]:
    return [claim.demand for claim in expiry.ended_claims(ledger)[1]]


def test_small_adjustments_of_the_clock_count_as_no_step(
    clock: Clock, expiry: Agenda, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    ledger = leased(("a", 60, 60))
    for _ in range(61):
        clock.pass_(1)
        clock.set_by(1)
        leases_in(expiry, ledger)
    assert ended(expiry, ledger) == ["a"]
    assert caplog.text == ""
    clock.set_by(3600)
    leases_in(expiry, ledger)
    assert "the clock jumped forward by 3600 s, so leases get their full term" in caplog.text


def test_it_looks_again_when_the_first_lease_ends(clock: Clock, expiry: Agenda) -> None:
    ledger = leased(("a", 20, 10), ("b", 600, 0))
    assert leases_in(expiry, ledger) == pytest.approx(30.01)
    clock.pass_(29.5)
    assert leases_in(expiry, ledger) == 1.0
    clock.pass_(100)
    assert leases_in(expiry, ledger) == 1.0, "it must not keep the clock busy"
    assert leases_in(expiry, Ledger()) == 60.0
    assert leases_in(expiry, leased(("b", 86_400, 0))) == 60.0


def test_an_end_that_moves_within_its_minute_is_seen(expiry: Agenda) -> None:
    ledger = leased(("a", 50, 0), ("b", 55, 0))
    assert leases_in(expiry, ledger) == pytest.approx(50, abs=0.1)
    (claim,) = ledger.claims_with("demand", "b")
    sooner = replace(claim, lease=Lease(20, 0, NOW + timedelta(seconds=20)))
    ledger = ledger.replace(claim.key, sooner)
    assert leases_in(expiry, ledger) == pytest.approx(20, abs=0.1)
