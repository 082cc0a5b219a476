"""The larger experiment's rules, checks and report, without ROS and without a cluster."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from demandops.detect import rule_file
from demandops.detect.rule_file import RuleFile

from examples.experiment.full import crowd, report, routes
from examples.experiment.full.measures import savings
from examples.experiment.full.outcome import Formed, Outcome, Settings
from examples.experiment.full.rules import Near, predicted

COUNT, OVER = 12, 60.0
NEAR = Near.read()
ROUTES = routes.many(1, COUNT)
AT = {route.vehicle: routes.MIDDLES.index(route.middle) for route in ROUTES}
PASSING = {vehicle: crowd.crossings(NEAR)[at] for vehicle, at in AT.items()}
POSES = predicted(ROUTES, NEAR, OVER)
EVENTS = crowd.events(POSES, PASSING, OVER)


def formed() -> list[Formed]:
    inside: dict[str, int] = {}
    found = []
    for event in EVENTS:
        if event.joins:
            inside[event.vehicle] = AT[event.vehicle]
        else:
            del inside[event.vehicle]
        found.append(Formed("", event.vehicle, event.joins, {}, crowd.requesters(inside)))
    return found


def outcome(found: list[Formed]) -> Outcome:
    return Outcome(
        settings=Settings(large=COUNT),
        routes=ROUTES,
        near=NEAR,
        set_off=0.0,
        over=OVER,
        poses=POSES,
        events=EVENTS,
        formed=found,
        left=frozenset(),
        before=frozenset(),
        crossings=crowd.crossings(NEAR),
    )


def faults(found: list[Formed]) -> list[str]:
    return [check.name for check in crowd.checks(outcome(found), AT) if not check.holds]


def test_each_vehicle_passes_one_intersection() -> None:
    assert sorted(str(event) for event in EVENTS) == sorted(
        f"{route.vehicle} {word}" for route in ROUTES for word in ("joins", "leaves")
    )
    assert {*AT.values()} == {*range(len(routes.MIDDLES))}


def test_demands_of_different_vehicles_may_overtake_and_others_are_found() -> None:
    assert faults(formed()) == []
    overtaken = [replace(one, bookkeeping=None) for one in formed()]
    overtaken[0], overtaken[1] = overtaken[1], overtaken[0]
    assert faults(overtaken) == []
    assert faults(formed()[1:])[0].startswith("the detector formed")
    wrong = [replace(formed()[0], bookkeeping={}), *formed()[1:]]
    assert faults(wrong) == [
        "at the commits whose bookkeeping was read, the requesters of every service and connection "
        "are right"
    ]


def test_the_report_draws_a_crowd() -> None:
    run = outcome(formed())
    page = report.page(run, crowd.checks(run, AT))
    assert page.count("<svg") == 3 and "vehicle000" not in page
    assert all(f">{station}<" in page for station in crowd.STATIONS)
    assert "carried to the edge" not in [saving.name for saving in savings(run)]


def test_the_rules_have_each_intersection_and_its_own_edge_and_station() -> None:
    file: RuleFile = rule_file.read(crowd.rules(NEAR), "rules.yaml")
    assert [rule.name for rule in file.rules] == [f"at-{station}" for station in crowd.STATIONS]
    for rule, edge, station in zip(file.rules, crowd.EDGES, crowd.STATIONS, strict=True):
        text = str(rule.deployment_request)
        ends = {*crowd.EDGES, *crowd.STATIONS}
        assert {name for name in ends if name in text} == {edge, station}
        assert "/edge'" not in text and "'edge'" not in text
    first, second, _ = crowd.crossings(NEAR)
    assert math.dist(first.point, second.point) == pytest.approx(1000)
