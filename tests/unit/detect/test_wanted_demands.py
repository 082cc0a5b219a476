"""One goal of an event is sent at a time, and a failed one again (``wanted_demands.yaml``)."""

from __future__ import annotations

from operator import itemgetter
from pathlib import Path
from typing import Any

import pytest
from demandops.detect.detector import Outcome, Sending, Want, WantedDemands
from demandops.detect.rule_file import Goal

from tests.kit import plain_yaml

STORIES = plain_yaml.load(Path(__file__).with_name("wanted_demands.yaml").read_text())
GOALS = {
    "put": Goal("demand", {"demand": "d", "requesters": ["a"], "applications": [1]}),
    "other": Goal("demand", {"demand": "d", "requesters": ["a"], "applications": [2]}),
    "join": Goal("deployment_request", {"id": "r", "apps": []}),
    "changed": Goal("deployment_request", {"id": "r", "apps": [1]}),
}


def key(event: str) -> tuple[str, tuple[str, ...]]:
    return event, ("a",)


def check(wanted: WantedDemands, step: dict[str, Any], under_way: list[Sending]) -> None:
    if "want" in step:
        times = {name: step[name] for name in ("retry_s", "renew_s") if name in step}
        goal = step["want"] and GOALS[step["want"]]
        wanted.want(Want(key(step.get("event", "rule")), goal, **times))
    if "answer" in step:
        assert wanted.answered(under_way.pop(), Outcome(), step["answer"]) == ""
    if "at" in step:
        now, sending = step["at"], wanted.next(step["at"])
        assert (sending and sending.purpose) == step["sends"]
        assert "next" not in step or wanted.next_at() == pytest.approx(step["next"])
        if sending is not None:
            assert sending.key == key(step.get("event", "rule"))
            assert sending.goal.data == step.get("data", sending.goal.data)
            if step.get("unanswered"):
                under_way.append(sending)
            else:
                texts = (step.get("code", ""), step.get("message", ""))
                told = wanted.answered(sending, Outcome(*texts, step.get("lease", 0.0)), now)
                assert told == step.get("logs", "")
    if "refused" in step:
        assert [*wanted.refusals()] == [(key("rule"), step["refused"])]
    assert wanted.unanswered() == step.get("lost", wanted.unanswered())
    assert len(wanted) == step.get("left", len(wanted))


@pytest.mark.parametrize("story", STORIES, ids=itemgetter("must"))
def test_a_story_of_wanted_demands(story: dict[str, Any]) -> None:
    wanted, under_way = WantedDemands(), list[Sending]()
    if "held" in story:
        wanted.hold(key("rule"), GOALS[story["held"]])
    for step in story["steps"]:
        check(wanted, step, under_way)
