"""The detector over a restart and new rules, and stories of its events and goals."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from itertools import combinations, product
from operator import itemgetter
from typing import Any

import pytest
from demandops.detect.detector import Detector, Outcome, Sending, Want, WantedDemands, booked_events
from demandops.detect.event_engine import Event, Key, Observation
from demandops.detect.rule_file import Goal
from hypothesis import given
from hypothesis import strategies as st

from tests.kit import plain_yaml
from tests.kit.chance import examples
from tests.kit.detection import POSE, SOURCES, Run, at, demand, file_of, rule

EVENTS, DEMANDS, BOOKED = (
    plain_yaml.beside(__file__, name) for name in ("events", "wanted_demands", "booked_demands")
)
NEAR = {"source": "cars", "point": {"x": 0, "y": 0}, "start": 84, "stop": 90}
POSITIONS = [{"node": "n", "x": "{x}"}]
RULES, MANY_RULES = (
    [rule(name, **fields) for name, fields in rules.items()]
    for rules in (BOOKED["rules"], plain_yaml.beside(__file__, "many_rules"))
)


def entry(*requesters: str) -> dict[str, Any]:
    return {"action": "Demand", "request": "", "requesters": sorted(requesters)}


def test_requesters_tell_the_entities_that_an_id_does_not() -> None:
    together = {"source": "cars", "start": 5, "stop": 8}
    for requesters in (["{entity}", "{other}"], ["{other}", "r", "{entity}"]):
        goal = demand(demand="{entity}-{other}", requesters=requesters)
        held = {one.strip("{}") for one in requesters} - {"entity", "other"} | {"car-1", "car-2"}
        books = {"demands": {"car-1-car-2": entry(*held)}}
        booked = booked_events(file_of(rule("pair", together=together, demand=goal)), books)
        assert {*booked} == {("pair", ("car-1", "car-2"))}


def test_the_booked_demands_of_rules_are_told_from_all_others() -> None:
    booked = booked_events(file_of(*RULES), BOOKED["books"])
    found = [[rule, *entities, goal.id] for (rule, entities), goal in booked.items()]
    assert sorted(found) == sorted(BOOKED["events"])
    released = {"demand": "at/car9", "requesters": ["car9"], "operation": "release"}
    assert booked["there", ("car9",)].ended().data == released
    assert booked_events(file_of(*RULES), {"services": {}}) == {}


def started(*rules: dict[str, Any]) -> Detector:
    detector = Detector(file_of(*rules), 0)
    detector.step([at(1, "car1", 80)], 1)
    return detector


def changes(detector: Detector, *rules: dict[str, Any]) -> dict[Key, Any]:
    wants = detector.replace_rules(file_of(*rules), 2, 5)
    return {want.key: want.goal and want.goal.data for want in wants}


def test_events_last_if_the_rules_are_replaced_by_the_same() -> None:
    detector = started(rule("a", near=NEAR))
    assert changes(detector, rule("b", near=NEAR), rule("a", near=NEAR)) == {}
    assert [event.rule for event, _ in detector.step([at(3, "car1", 85)], 3)] == []
    assert [event.rule for event, _ in detector.step([at(4, "car1", 91)], 4)] == ["a"]


CHANGED = rule("a", near=NEAR, demand=demand(demand="{entity}", positions=POSITIONS))
WANTED = {"demand": "car1", "requesters": ["car1"], "positions": [{"node": "n", "x": 80}]}


@pytest.mark.parametrize(
    ("rules", "wanted"),
    [([], None), ([rule("a", near=NEAR, entities=["bus*"])], None), ([CHANGED], WANTED)],
    ids=[
        "the rule is gone",
        "it is for others",
        "it wants another demand",
    ],
)
def test_what_new_rules_want_of_an_event_that_lasts(rules: list[Any], wanted: Any) -> None:
    assert changes(started(rule("a", near=NEAR)), *rules) == {("a", ("car1",)): wanted}


def test_a_changed_demand_is_not_wanted_without_the_values_that_a_restart_lost() -> None:
    detector = Detector(file_of(rule("a", near=NEAR)), 0)
    books = {"demands": {"a/car1": entry("r")}}
    assert detector.resume(booked_events(detector.file, books), 0, 5)
    assert changes(detector, CHANGED) == {}


def test_an_entity_that_does_not_come_back_after_a_restart_is_gone() -> None:
    detector = Detector(file_of(*RULES), 0)
    booked = booked_events(file_of(*RULES), {"demands": {"puts/bus1": entry("r")}})
    (want,) = detector.resume(booked, 0, 5)
    assert want.goal is not None and want.goal.id == "puts/bus1"
    assert detector.step([], 4.9) == []
    ((event, want),) = detector.step([], 5)
    assert (event.why, want.goal) == ("bus1 has not been seen since the start", None)


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


GOALS = {name: Goal(action, data) for name, (action, data) in BOOKED["goals"].items()}


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


# ---- rules for many entities, compared with each rule for its entities alone ----


TICK = 0.5
NAMES = {"cars": ("a", "b", "c", "d"), "bikes": ("a", "e")}
EVERYBODY = [(source, name) for source, names in NAMES.items() for name in names]


def alone(one: dict[str, Any]) -> Iterable[Iterable[tuple[str, str]]]:
    """Yield the entities on which each event of a rule depends."""
    if "count" in one:
        return [EVERYBODY]
    if "near" in one:
        return [[who] for who in EVERYBODY]
    first, other = (one["together"].get(end, "cars") for end in ("source", "other"))
    if first == other:
        return combinations([(first, name) for name in NAMES[first]], 2)
    return product(*([(source, name) for name in NAMES[source]] for source in (first, other)))


coordinate = st.one_of(st.integers(0, 9), st.integers(-4, 34))
moment = st.tuples(
    st.integers(0, 5),
    st.lists(st.tuples(st.sampled_from(EVERYBODY), coordinate, coordinate), max_size=6),
    st.booleans(),
)


@examples(150)
@given(st.lists(moment, max_size=12))
def test_a_rule_tells_of_many_entities_what_it_tells_of_them_alone(
    moments: list[tuple[int, list[Any], bool]],
) -> None:
    def events(rules: list[dict[str, Any]], seen: Iterable[tuple[str, str]]) -> list[Any]:
        run, now, pending, told = Run(*rules), 0.0, list[Observation](), list[Event]()
        for ticks, heard, steps in moments:
            now += ticks * TICK
            pending += [
                at(now, name, x, y, who) for (who, name), x, y in heard if (who, name) in seen
            ]
            if steps:
                told += run.step(now, *pending)
                pending = []
        told += run.step(now, *pending)
        return [(event.at, event.rule, event.subjects, event.starts) for event in told]

    apart = [event for one in MANY_RULES for who in alone(one) for event in events([one], [*who])]
    assert sorted(events(MANY_RULES, EVERYBODY)) == sorted(apart)
