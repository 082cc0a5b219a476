"""Long random sequences of requests give the same bookkeeping in a real state repo as in a model.

The model in ``tests/model`` takes the same requests. After each call of `demandops request`, and
at some of the commits that the calls made, both must have the same bookkeeping.
"""

from __future__ import annotations

import json
import os
from random import Random
from typing import Any

import pytest
from demandops.model.demand.goals import form_faults

from tests.integration.conftest import On
from tests.kit.repo import assert_sound, git
from tests.model.books import Books
from tests.model.goals import SKELETON, Maker
from tests.model.listed import Goal
from tests.model.view import in_model_words, object_lists
from tests.model.view import view as view_of

REQUESTS, CALLS = 120, 6
SEEDS = range(1, 1 + int(os.environ.get("DEMANDOPS_EXAMPLES", "1")))


def view(on: On, revision: str) -> dict[str, Any]:
    """Return the bookkeeping at a commit in the form of the model."""
    data = on.json("bookkeeping", "--at", revision)
    assert data.pop("commit") == git(on.state, "rev-parse", revision)
    return in_model_words(data, object_lists(on.state.files("clusters/", revision).values()))


def send(on: On, goals: list[Goal]) -> tuple[int, list[dict[str, Any]], list[str]]:
    """Send goals in one call; return its exit code, its rows and the commits that it made."""
    before = on.state.tip
    ran = on.request(*json.loads(json.dumps(goals)))  # copies shared lists: no YAML anchors
    made = git(on.state, "rev-list", "--reverse", f"{before}..main").split()
    return ran.code, ran.json(), made


@pytest.mark.parametrize("seed", SEEDS)
def test_a_state_repo_says_what_the_model_says_after_any_sequence_of_requests(
    seed: int, on: On
) -> None:
    books, first = Books(SKELETON), on.state.tip
    made = Maker(Random(seed)).sequence(2 * REQUESTS)
    # with a goal that cannot be parsed, a call books nothing
    goals = [goal for goal in made if not form_faults(goal)][:REQUESTS]
    views: dict[str, dict[str, Any]] = {}
    for call in range(CALLS):
        asked = goals[call * REQUESTS // CALLS : (call + 1) * REQUESTS // CALLS]
        expected, after_each = [], []
        for request in asked:
            expected.append(books.take(request))
            if expected[-1].touched:
                after_each.append(view_of(books))
        code, rows, made = send(on, asked)
        assert [row["outcome"] for row in rows] == [result.outcome for result in expected]
        assert [row["index"] for row in rows] == list(range(len(asked)))
        assert [row["request"] for row in rows] == [goal["id"] for goal in asked]
        done = [row["commit"] for row in rows if row["outcome"] in ("booked", "released")]
        assert done == made, "each demand that changes something must have a commit, in order"
        refused = [row["outcome"] == "refused" for row in rows]
        assert [bool(row["faults"]) for row in rows] == refused
        assert [row["commit"] is None for row in rows] == refused
        assert code == any(refused)
        assert view(on, "main") == view_of(books)
        views |= dict(zip(made, after_each, strict=True))
    assert len(views) > REQUESTS // 4
    for commit in Random(seed).sample(sorted(views), 6):
        assert view(on, commit) == views[commit]
    verdicts = on.json("verify", f"{first}..main")
    assert [verdict["commit"] for verdict in verdicts] == list(views)
    assert [one for one in verdicts if one["skipped"]] == []
    assert_sound(on.state.path)


def test_sending_everything_again_makes_no_further_commit(on: On) -> None:
    maker = Maker(Random(3), calm=True)
    goals = [maker.join() for _ in range(20)]
    send(on, goals)
    newest = on.state.tip
    code, rows, made = send(on, [maker.again(request) for request in goals])
    assert (code, made) == (0, [])
    assert {row["outcome"] for row in rows} == {"unchanged"}
    assert {row["commit"] for row in rows} == {newest}
