"""The node is killed amid bursts of goals; each accepted goal is booked, or its refusal is logged.

The node is killed three times by default, and a hundred times with ``GOAL_KILLS=100``.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from random import Random

import pytest

from tests.kit import rig
from tests.kit.cli import Run
from tests.kit.goals import link as connection
from tests.kit.limits import LONGEST_TEST_S
from tests.kit.repo import git
from tests.kit.ros import Client, Sent, Serve, Served

KILLS = int(os.environ.get("GOAL_KILLS", "3"))
BURST = 40


def _goal(number: int) -> rig.Goal:
    """Return a goal; every fourth goal names an unknown node, so that it is refused."""
    wrong = {} if number % 4 else {"target_node_id": "egde"}
    return {**connection(number % BURST, **wrong), "id": f"request{number}"}


def _killed_in_a_burst(served: Served, client: Client, goals: range, answers: int) -> list[Sent]:
    """Send the goals, kill the node between its answers, and return the sent goals.

    The kill comes after at least `answers` answers, while an accepted goal still waits for one.
    """
    served.wait_for("taking demands")
    for _ in range(100):  # the client may still know only the node that was killed
        first = client.send(_goal(0))
        with suppress(AssertionError):
            client.wait(lambda: first.answered, 2)  # noqa: B023
            break
    else:
        raise AssertionError(served.last_words())
    sent = [client.send(_goal(number)) for number in goals]

    def owes() -> bool:
        open_goals = sum(bool(goal.accepted) and not goal.answered for goal in sent)
        return bool(open_goals) and sum(goal.answered for goal in sent) >= answers

    client.wait(owes)
    served.process.kill()
    served.process.wait()
    return sent


@pytest.mark.limit(LONGEST_TEST_S + 30 * KILLS)
def test_killed_in_a_burst_each_accepted_goal_is_booked_or_refused_in_the_log(
    serve: Serve, client: Client, bare: Path, demandops: Run
) -> None:
    random, answered = Random(KILLS), dict[int, bool]()
    for kill in range(KILLS):
        goals = range(1 + kill * BURST, 1 + (kill + 1) * BURST)
        sent = _killed_in_a_burst(serve(bare), client, goals, random.randrange(BURST // 2))
        of_each = zip(goals, sent, strict=True)
        answered |= {number: goal.answered for number, goal in of_each if goal.accepted}
    served = serve(bare)
    served.wait_for("taking demands")
    none = "0 demands are accepted and not published\n"
    listed = ("journal", "--state-repo", bare)
    rig.wait_until(lambda: demandops(*listed).out == none, "the journal is empty")
    assert served.stop() == 0

    trailer = "--format=%(trailers:key=Request-Id,valueonly)"
    booked = git(bare, "log", trailer, "main").split()
    log = "".join(path.read_text() for path in served.log.parent.glob("node-*.log"))
    reasons = ("unknown-node: ", "the demand was refused, but the reason was lost")
    refused = [line for line in log.splitlines() if any(reason in line for reason in reasons)]
    shown = {n for n in answered if any(f"'request{n}'" in line for line in refused)}
    assert shown == {number for number in answered if number % 4 == 0}
    assert {f"request{number}" for number in answered.keys() - shown} <= set(booked)
    assert len(booked) == len(set(booked)), "a goal was booked twice"
    unanswered = [number for number, is_answered in answered.items() if not is_answered]
    print(f"{KILLS} kills: {len(answered)} accepted, {len(unanswered)} of them not answered")
    assert unanswered, "no kill came while a goal waited for its answer"
