"""Stories of the events that rules give, and of the goals that are sent for them."""

from __future__ import annotations

from datetime import datetime
from operator import itemgetter
from pathlib import Path
from typing import Any

import pytest
from demandops.detect.detector import Outcome, Sending, Want, WantedDemands
from demandops.detect.observations import Observation
from demandops.detect.rule_file import Goal

from tests.kit import plain_yaml
from tests.kit.detection import POSE, SOURCES, Run, at, rule

NEAR = {"source": "cars", "point": {"x": 0, "y": 0}, "start": 84, "stop": 90}
EVENTS, DEMANDS = (
    plain_yaml.load(Path(__file__).with_name(f"{name}.yaml").read_text())
    for name in ("events", "wanted_demands")
)


def seconds(time: float | datetime) -> float:
    return time.timestamp() if isinstance(time, datetime) else time


def heard(now: float, one: Any) -> Observation:
    return at(*one) if isinstance(one, list) else Observation("batteries", "a", now, None, one)


@pytest.mark.parametrize("story", EVENTS, ids=itemgetter("must"))
def test_a_story_of_events(story: dict[str, Any]) -> None:
    slow = {"topic": "/slow/{entity}", "type": POSE, "timeout": story.get("slow", "1s")}
    rules = [rule(name, **fields) for name, fields in story["rules"].items()]
    run = Run(*rules, now=seconds(story.get("now", 0)), sources={**SOURCES, "slow": slow})
    if "held" in story:
        held, unknown = (
            [(name, tuple(entities)) for name, *entities in story.get(part, ())]
            for part in ("held", "unknown")
        )
        run.state = run.engine.start(0, [*held, *unknown], settle_s=story["settle"])
        assert run.state.lasting == {*held}
    for step in story["steps"]:
        run.state = run.state.shifted(step.get("clock", 0))
        now = seconds(step["at"])
        told = run.told(now, *(heard(now, one) for one in step.get("hears", ())))
        lines = [" ".join([*filter(None, words), f"{time:.10g}"]) for *words, time in told]
        assert lines == step.get("tells", []), step


def test_an_event_says_what_has_happened() -> None:
    run = Run(rule("near", near=NEAR))
    (event,) = run.step(1, at(1, "a", 30, 40))
    assert event.why == "a is 50.0 m from the area"
    assert event.values == {"rule": "near", "entity": "a", "x": 30, "y": 40, "distance": 50}
    (event,) = run.step(9)
    assert (event.why, event.at) == ("a has been silent for 3 s", 4)


def test_a_step_leaves_the_state_before_as_it_was() -> None:
    run = Run(
        rule("near", near=NEAR), rule("pair", together={"source": "cars", "start": 5, "stop": 8})
    )
    run.step(1, at(1, "a", 0), at(1, "b", 1))
    before = run.state
    first = run.engine.step(before, [at(2, "a", 95)], 2)
    assert run.engine.step(before, [at(2, "a", 95)], 2) == first
    assert len(first[1]) == 2


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


@pytest.mark.parametrize("story", DEMANDS, ids=itemgetter("must"))
def test_a_story_of_wanted_demands(story: dict[str, Any]) -> None:
    wanted, under_way = WantedDemands(), list[Sending]()
    if "held" in story:
        wanted.hold(key("rule"), GOALS[story["held"]])
    for step in story["steps"]:
        check(wanted, step, under_way)
