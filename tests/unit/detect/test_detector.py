"""A restart or new rules do not make the detector end an event and start it again."""

from __future__ import annotations

from typing import Any

from demandops.detect.detector import Detector, booked_events
from demandops.detect.observations import Key

from tests.kit.detection import at, demand, file_of, rule

NEAR = {"source": "cars", "point": {"x": 0, "y": 0}, "start": 84, "stop": 90}
LEVELS = {"start": 2, "stop": 1}
POSITIONS = [{"node": "n", "x": "{x}"}]
REQUEST = {
    "id": "station/perception",
    "connections": [{"id": "{entity}/edge", "requester_ids": ["{entity}", "station"]}],
}
RULES = [
    rule("joins", near=NEAR, deploymentRequest=REQUEST, entities=["car*"]),
    rule("puts", near=NEAR, entities=["bus*"]),
    rule("pair", together={"source": "cars", "start": 5, "stop": 8}),
    rule("full", count={"source": "cars", "point": {"x": 0, "y": 0}, "radius": 9, **LEVELS}),
    rule("there", near=NEAR, demand=demand(demand="at/{entity}", positions=POSITIONS)),
]


def entry(*requesters: str, request: str = "", joined: bool = False) -> dict[str, Any]:
    action = "DeploymentRequest" if joined else "Demand"
    return {"action": action, "request": request, "requesters": sorted(requesters)}


def test_requesters_tell_the_entities_that_an_id_does_not() -> None:
    together = {"source": "cars", "start": 5, "stop": 8}
    for requesters in (["{entity}", "{other}"], ["{other}", "r", "{entity}"]):
        goal = demand(demand="{entity}-{other}", requesters=requesters)
        held = {one.strip("{}") for one in requesters} - {"entity", "other"} | {"car-1", "car-2"}
        books = {"demands": {"car-1-car-2": entry(*held)}}
        booked = booked_events(file_of(rule("pair", together=together, demand=goal)), books)
        assert {*booked} == {("pair", ("car-1", "car-2"))}


def test_the_booked_demands_of_rules_are_told_from_all_others() -> None:
    books = {
        "demands": {
            "f00d": entry("station", "car7", request="station/perception", joined=True),
            "f01d": entry("station", "tram", request="station/perception", joined=True),
            "f02d": entry("car8", request="station/perception", joined=True),
            "f03d": entry("station", "car7", request="other", joined=True),
            "puts/bus1": entry("r"),
            "puts/car1": entry("r"),
            "puts/bus1/x": entry("r"),
            "pair/a/b": entry("r"),
            "full": entry("r"),
            "at/car9": entry("car9"),
            "at/car8": entry("car9"),
        },
        "waiting": [{"demand": "puts/bus2", "requesters": ["r"], "since": "", "priority": 0}],
    }
    booked = booked_events(file_of(*RULES), books)
    assert {key: goal.id for key, goal in booked.items()} == {
        ("joins", ("car7",)): "station/perception",
        ("puts", ("bus1",)): "puts/bus1",
        ("puts", ("bus2",)): "puts/bus2",
        ("pair", ("a", "b")): "pair/a/b",
        ("full", ()): "full",
        ("there", ("car9",)): "at/car9",
    }
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


def test_the_demands_of_a_rule_that_is_gone_or_for_others_end() -> None:
    for rules in ([], [rule("a", near=NEAR, entities=["bus*"])]):
        assert changes(started(rule("a", near=NEAR)), *rules) == {("a", ("car1",)): None}


def test_a_changed_demand_is_wanted_with_the_values_of_the_events_start() -> None:
    changed = rule("a", near=NEAR, demand=demand(demand="{entity}", positions=POSITIONS))
    wanted = {"demand": "car1", "requesters": ["car1"], "positions": [{"node": "n", "x": 80}]}
    assert changes(started(rule("a", near=NEAR)), changed) == {("a", ("car1",)): wanted}


def test_an_entity_that_does_not_come_back_after_a_restart_is_gone() -> None:
    detector = Detector(file_of(*RULES), 0)
    booked = booked_events(file_of(*RULES), {"demands": {"puts/bus1": entry("r")}})
    (want,) = detector.resume(booked, 0, 5)
    assert want.goal is not None and want.goal.id == "puts/bus1"
    assert detector.step([], 4.9) == []
    ((event, want),) = detector.step([], 5)
    assert (event.why, want.goal) == ("bus1 has not been seen since the start", None)
