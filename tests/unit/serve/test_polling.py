"""The times at which the state repo is polled; most tests use a clock that they move themselves."""

from __future__ import annotations

import logging

import pytest
from demandops.base.runtime import REAL
from demandops.serve.timing.timers import PollTimer, parse_interval
from demandops.serve.worker import RemoteMonitor

from tests.kit.clock import Clock
from tests.kit.memory import NOW


@pytest.fixture
def clock() -> Clock:
    return Clock(NOW)


def test_the_first_look_is_due_at_once_and_the_next_after_the_interval(clock: Clock) -> None:
    made = PollTimer(30, clock)
    assert made.start_if_due()
    made.finished(reached=True)
    assert made.seconds_until_due() == 30 and not made.start_if_due()
    clock.pass_(30)
    assert made.start_if_due()


@pytest.mark.parametrize(
    ("interval", "is_local", "reached", "pauses"),
    [
        (10, False, [False] * 5 + [True], [20, 40, 60, 60, 60, 10]),
        (600, False, [False, True], [600, 600]),  # above the bound
        (30, True, [True], [1]),  # on this disk a look costs little
        (0, True, [True], [None]),
    ],
)
def test_while_the_remote_is_away_looks_become_seldom_within_bounds(
    clock: Clock, interval: float, is_local: bool, reached: list[bool], pauses: list[float | None]
) -> None:
    made, found = PollTimer(interval, clock, local=is_local), []
    for is_reached in reached:
        made.finished(reached=is_reached)
        found.append(made.seconds_until_due())
    assert found == pauses


def test_many_requests_give_one_poll_and_one_more_after_it(clock: Clock) -> None:
    made = PollTimer(0, clock)
    assert made.seconds_until_due() is None and not made.start_if_due()
    for _ in range(3):
        made.request()
    assert made.start_if_due()
    assert not made.start_if_due()
    made.request()  # this comes during the poll, which may have missed the cause of the request
    made.finished(reached=True)
    assert made.seconds_until_due() == 0.5, "a burst of requests must not give one poll each"
    clock.pass_(0.5)
    assert made.start_if_due()
    made.finished(reached=True)
    assert made.seconds_until_due() is None


def test_by_chance_looks_come_earlier_and_never_later() -> None:
    made = PollTimer(100, REAL)
    pauses = set()
    for _ in range(50):
        made.finished(reached=True)
        pauses.add(made.seconds_until_due())
    assert len(pauses) > 10
    assert all(pause is not None and 80 <= pause <= 100 for pause in pauses)


@pytest.mark.parametrize(
    ("text", "seconds"), [("30s", 30), ("1h30m", 5400), ("0", 0), ("0s", 0), ("0.2", 0.2)]
)
def test_an_interval_is_a_duration_or_seconds(text: str, seconds: float) -> None:
    assert parse_interval(text) == seconds


@pytest.mark.parametrize("text", ["", "-1", "often", "1e9", "30 s", "nan"])
def test_anything_else_is_no_interval(text: str) -> None:
    with pytest.raises(ValueError, match="is not a duration"):
        parse_interval(text)


def test_away_and_back_are_logged_once_each(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="demandops")
    remote = RemoteMonitor("https://git.example/state.git", clock)
    remote.record_reached()
    for _ in range(3):
        remote.record_unreachable("cannot be fetched: no route")
    assert remote.status.unreachable == "cannot be fetched: no route"
    clock.pass_(90)
    for _ in range(3):
        remote.record_reached(pushed=True)
    away, back = caplog.messages
    assert away.startswith("cannot be fetched: no route; trying again")
    assert back == "https://git.example/state.git is back after 90 s"
    assert not remote.status.unreachable and remote.status.last_push is not None


def test_a_push_that_is_denied_is_remembered_until_one_is_taken(clock: Clock) -> None:
    remote = RemoteMonitor("somewhere", clock)
    remote.record_push_denied("takes no push: frozen")
    remote.record_reached()
    assert (remote.status.push_denied, remote.status.unreachable) == ("takes no push: frozen", "")
    remote.record_reached(pushed=True)
    assert remote.status.push_denied == ""
