"""What one run of the experiment does not show: its checks can fail, and other seeds play too."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.detect import rule_file
from rosbags.rosbag2 import StoragePlugin

from examples.experiment import paper
from examples.experiment.full import fleet, large, report, routes, unlisted
from examples.experiment.full.checks import checks
from examples.experiment.full.outcome import Formed, Outcome, Settings, savings, steps
from examples.experiment.full.participants import EGO_DATA
from examples.experiment.full.process_runner import Container, RunningPod, path_in_pod
from examples.experiment.full.rules import Event, Near, bag_tracks, causes, events_of, predicted
from tests.e2e.common.expected import DETECTION, FUSION, source_end, target_end
from tests.kit import plain_yaml
from tests.kit.detection import write_bag

NEAR, GAP_S, OVER = Near.read(), 10.0, 60.0
VEHICLE = "vehicle00"
EGO = EGO_DATA.format(VEHICLE)
NODE_OF = {
    FUSION: "edge",
    **dict.fromkeys(DETECTION.values(), "edge"),
    **{target_end(source): "edge" for source in ("station00", VEHICLE)},
    **{source_end(source): source for source in ("station00", VEHICLE)},
}


def pod(service: str, bound: float, ended: float) -> RunningPod:
    container = {"resources": {"requests": {"cpu": "50m", "memory": "64Mi"}}}
    manifest = {
        "metadata": {"name": f"{service}-x", "labels": {"app.kubernetes.io/instance": service}},
        "spec": {"nodeName": f"node-{NODE_OF[service]}", "containers": [container]},
    }
    return RunningPod(manifest, Path(), bound, [Container("c", [], {}, starts=[bound])], ended)


def good() -> Outcome:
    """Return a run of one vehicle that passes all checks."""
    way = routes.one(0, GAP_S)
    poses = predicted(way, NEAR, OVER)
    joins, leaves = events = events_of(poses, NEAR, OVER)
    inside = [pose for pose in poses if joins.at + 3 <= pose.at <= leaves.at]
    stages = {"admitted": 0.1, "committed": 0.2, "pushed": 0.3}
    formed = [
        Formed(
            commit=str(event),
            vehicle=VEHICLE,
            joins=event.joins,
            stages={stage: event.at + after for stage, after in stages.items()},
            bookkeeping=paper.requesters({VEHICLE} if event.joins else ()),
        )
        for event in events
    ]
    inputs = [(-1.0, ()), (joins.at + 2, {VEHICLE}), (leaves.at + 1, ())]
    return Outcome(
        settings=Settings(short=True),
        routes=way,
        near=NEAR,
        set_off=0.0,
        over=OVER,
        poses=poses,
        events=events,
        formed=formed,
        pods=[pod(service, joins.at + 1, leaves.at + 1) for service in NODE_OF],
        node_ids={f"node-{node}": node for node in fleet.NODES},
        inputs=[(at, fleet.fusion_inputs(vehicles)) for at, vehicles in inputs],
        tracks=[(pose.at + 0.1, [(pose.x, pose.y)]) for pose in inside],
        arrivals={EGO: [pose.at + 0.1 for pose in inside]},
        published={EGO: 1000},
        carried={f"mqtt-prefix{EGO}": 400, "mqtt_client/ros_msg_type/x": 7},
        left=frozenset({"ConfigMap demandops-domain"}),
        before=frozenset({"ConfigMap demandops-domain"}),
    )


def faults(outcome: Outcome) -> list[str]:
    return [check.name for check in checks(outcome) if not check.holds]


def on_edge(one: RunningPod) -> RunningPod:
    return replace(one, manifest=one.manifest | {"spec": {"nodeName": "node-edge"}})


def restarted(one: RunningPod) -> RunningPod:
    return replace(one, containers=[Container("c", [], {}, starts=[1.0, 2.0])])


BREAKS: dict[str, tuple[Callable[[Outcome], dict[str, Any]], str]] = {
    "no demand": (lambda run: {"formed": []}, "plain script"),
    "a demand too much": (lambda run: {"formed": [*run.formed, run.formed[0]]}, "plain script"),
    "other requesters": (
        lambda run: {"formed": [replace(run.formed[0], bookkeeping={}), run.formed[1]]},
        "requesters of every service",
    ),
    "no input": (lambda run: {"inputs": run.inputs[:1]}, "fusion subscribed"),
    "an input too much": (
        lambda run: {"inputs": [(at, topics | {"/x"}) for at, topics in run.inputs]},
        "fusion subscribed",
    ),
    "a restart": (lambda run: {"pods": [*map(restarted, run.pods)]}, "fusion subscribed"),
    "no data": (lambda run: {"arrivals": {}}, "data arrived"),
    "data afterwards": (
        lambda run: {"arrivals": {EGO: [*run.arrivals[EGO], OVER - 1]}},
        "data arrived",
    ),
    "data before": (lambda run: {"early": 1}, "before the first demand"),
    "the wrong node": (lambda run: {"pods": [*map(on_edge, run.pods)]}, "every pod ran on"),
    "not fused": (lambda run: {"tracks": []}, "fusion published"),
    "something left": (lambda run: {"left": frozenset({"Pod x"})}, "at the end only"),
}


@pytest.mark.parametrize("name", BREAKS)
def test_each_check_fails_without_its_subject(name: str) -> None:
    change, check = BREAKS[name]
    run = good()
    assert faults(run) == []
    assert any(check in found for found in faults(replace(run, **change(run))))


def test_what_comes_back_must_come_while_a_vehicle_is_near_and_only_then() -> None:
    run = good()
    come = run.arrivals[EGO]
    for found, holds in ((come, True), ([], False), ([*come, OVER - 1], False)):
        *_, check = unlisted.checks(
            replace(run, delivered={topic: {VEHICLE: found} for topic in unlisted.BACK})
        )
        assert check.holds is holds
    assert unlisted.requesters({VEHICLE}).items() > paper.requesters({VEHICLE}).items()


def test_the_times_of_events_what_is_saved_and_the_report() -> None:
    run = good()
    joins, leaves = (step.delays() for step in steps(run))
    assert joins == pytest.approx(
        {"demand": 0.1, "commit": 0.3, "pods": 1.0, "fused": 3.1}, abs=0.2
    )
    assert leaves == pytest.approx({"demand": 0.1, "commit": 0.3, "pods": 1.0})
    pods, cores, memory, carried = savings(run)
    stay = run.events[1].at - run.events[0].at
    assert (pods.always, pods.saved) == (len(NODE_OF), pytest.approx(1 - stay / OVER))
    assert (cores.always, memory.always) == pytest.approx((0.05 * len(NODE_OF), 64 * len(NODE_OF)))
    assert carried.saved == pytest.approx(0.6)
    page = report.page(run, checks(replace(run, early=3)))
    assert '<span class="fault">fault</span> nothing arrived on the edge' in page
    assert page.count("<svg") == 3


# ---- routes ----


def events(seed: int) -> list[Event]:
    return events_of(predicted(routes.four(seed, GAP_S), NEAR, 95), NEAR, 95)


def test_each_seed_has_an_order_of_its_own_and_seed_0_the_paper_s() -> None:
    assert NEAR.start == routes.RADIUS_M == 84
    assert [str(event) for event in events(0)] == list(paper.STEPS)
    orders = [tuple(map(str, events(seed))) for seed in range(7)]
    assert {tuple(sorted(order)) for order in orders} == {tuple(sorted(paper.STEPS))}
    assert len(set(orders)) > 5
    for seed in range(7):
        times = [event.at for event in events(seed)]
        assert min(later - at for at, later in itertools.pairwise(times)) > GAP_S / 4


@pytest.mark.parametrize("seed", range(5))
def test_few_of_many_vehicles_are_near_at_once_and_no_two_events_coincide(seed: int) -> None:
    vehicles = [f"vehicle{number}" for number in range(20)]
    near = Near.read(unlisted.FILES / "rules.yaml")
    found = events_of(predicted(routes.crowd(seed, 6.0, vehicles), near, 400), near, 400)
    assert sorted(event.vehicle for event in found) == sorted(vehicles * 2)
    assert max(itertools.accumulate(1 if event.joins else -1 for event in found)) <= 4
    assert min(later.at - event.at for event, later in itertools.pairwise(found)) > 2


@pytest.mark.parametrize("vehicle", routes.VEHICLES)
def test_a_vehicle_falls_silent_while_nothing_else_happens(vehicle: str) -> None:
    for seed in range(30):
        silent = routes.vanishing(routes.four(seed, GAP_S), vehicle)
        (moment,) = (route.vanishes for route in silent if route.vehicle == vehicle)
        others = [at for route in silent for at in (route.enters, route.leaves)]
        assert min(abs(moment - at) for at in others) > 1


def test_a_vehicle_that_falls_silent_leaves_after_the_time_out_because_of_its_last_pose() -> None:
    poses = predicted(routes.vanishing(routes.one(0, GAP_S), VEHICLE), NEAR, OVER)
    joins, leaves = events_of(poses, NEAR, OVER)
    assert (joins.joins, leaves.joins) == (True, False)
    assert leaves.at == pytest.approx(2.5 * GAP_S + NEAR.timeout, abs=0.21)
    assert causes(poses, NEAR, OVER) == pytest.approx([GAP_S, 2.5 * GAP_S], abs=0.11)


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_played_recording_gives_the_recorded_events(
    tmp_path: Path, plugin: StoragePlugin
) -> None:
    poses = predicted(routes.vanishing(routes.four(3, GAP_S), "vehicle01"), NEAR, 95)
    write_bag(tmp_path / "bag", ((p.at + 1e9, p.vehicle, p.x, p.y) for p in poses), plugin)
    played = events_of(predicted(bag_tracks(tmp_path / "bag", NEAR), NEAR, 110), NEAR, 110)
    recorded = events_of(poses, NEAR, 95)
    assert [str(event) for event in played] == [str(event) for event in recorded]
    expected = [event.at + routes.LEAD_S for event in recorded]
    assert [event.at for event in played] == pytest.approx(expected, abs=0.7)


@pytest.mark.parametrize(
    ("vehicle", "away", "problem"),
    [
        ("vehicle01", 50, "vehicle01 begins within 90 m of the station; start the recording"),
        ("tram", 200, "has poses of tram; the experiment has nodes for vehicle00"),
    ],
)
def test_a_bag_that_cannot_be_played_is_refused_with_the_reason(
    tmp_path: Path, vehicle: str, away: float, problem: str
) -> None:
    write_bag(tmp_path / "bag", [(1e9, vehicle, NEAR.point[0] + away, NEAR.point[1])])
    with pytest.raises(SystemExit, match=problem):
        bag_tracks(tmp_path / "bag", NEAR)


# ---- what only an option of the experiment shows ----


def test_the_rules_for_zenoh_keep_all_names_of_topics() -> None:
    text = fleet.rules("zenoh")
    assert rule_file.read(text, "rules.yaml").rules
    for rule in yaml.safe_load(text)["rules"]:
        for connection in rule["deploymentRequest"]["connections"]:
            assert connection["source_topics"] == connection["target_topics"]


def test_the_larger_experiment_s_rules_events_and_checks() -> None:
    ways = routes.many(1, 12)
    at = {route.vehicle: routes.MIDDLES.index(route.middle) for route in ways}
    places = large.crossings(NEAR)
    poses = predicted(ways, NEAR, OVER)
    found = large.crossing_events(poses, {v: places[n] for v, n in at.items()}, OVER)
    assert sorted(map(str, found)) == sorted(
        f"{v} {word}" for v in at for word in ("joins", "leaves")
    )
    rules = rule_file.read(large.rules(NEAR), "rules.yaml").rules
    for rule, edge, station in zip(rules, large.EDGES, large.STATIONS, strict=True):
        text = str(rule.deployment_request)
        ends = {name for name in (*large.EDGES, *large.STATIONS) if name in text}
        assert ends == {edge, station} and "/edge'" not in text and "'edge'" not in text
    inside: dict[str, int] = {}
    formed = []
    for event in found:
        inside |= {event.vehicle: at[event.vehicle]}
        if not event.joins:
            del inside[event.vehicle]
        formed.append(Formed("", event.vehicle, event.joins, {}, large.requesters(inside)))
    run = replace(good(), routes=ways, poses=poses, events=found, formed=formed, crossings=places)
    run = replace(run, pods=[], arrivals={}, carried={})

    def wrong(*formed: Formed) -> list[str]:
        outcome = replace(run, formed=list(formed))
        return [check.name.split()[0] for check in large.checks(outcome, at) if not check.holds]

    assert wrong(*formed) == []
    first, second, *rest = (replace(one, bookkeeping=None) for one in formed)
    assert wrong(second, first, *rest) == []  # demands of different vehicles may overtake
    assert "the" in wrong(*formed[1:])
    assert wrong(replace(formed[0], bookkeeping={}), *formed[1:]) == ["at"]
    page = report.page(run, large.checks(run, at))
    assert page.count("<svg") == 3 and "vehicle000" not in page
    assert all(f">{station}<" in page for station in large.STATIONS)


@pytest.mark.parametrize(("text", "found"), plain_yaml.beside(__file__))
def test_a_path_below_a_mount_becomes_one_of_this_machine(text: str, found: str) -> None:
    mounts = {"/config": "/pod/c", "/config/deep": "/pod/d", "/tmp": "/tmp/pod/t"}
    assert path_in_pod(text, mounts | {"/params": "/tmp/pod/i"}) == found


def test_one_module_of_the_examples_imports_the_tests() -> None:
    files = Path(paper.__file__).parents[1].rglob("*.py")
    importing = re.compile(r"^\s*(?:from|import) tests\b", re.MULTILINE)
    assert [file.name for file in files if importing.search(file.read_text())] == ["rig.py"]
