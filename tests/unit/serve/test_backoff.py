"""The pauses between tries grow up to a bound. While pushes fail, a push has fewer demands."""

from __future__ import annotations

from demandops.base.runtime import REAL
from demandops.serve.timing.timers import FIRST_PAUSE_S, LONGEST_AWAY_S, LONGEST_TURN_S, Backoff


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
    assert pace.unreachable() <= FIRST_PAUSE_S
    for _ in range(10):
        pace.overtaken(10, 0.1, 1.0)
    pace.published()
    assert pace.overtaken(10, 0.1, 1.0) <= FIRST_PAUSE_S


def test_a_batch_takes_no_more_demands_than_are_evaluated_during_one_push() -> None:
    pace = Backoff(200, REAL)
    assert pace.max_demands == 200
    for demands, evaluating_s, most in ((100, 0.1, 100), (100, 1.0, 20), (2, 100.0, 1), (1, 0, 1)):
        pace.overtaken(demands, evaluating_s=evaluating_s, pushing_s=0.2)
        assert pace.max_demands == most
    pace.published()
    assert pace.max_demands == 200
