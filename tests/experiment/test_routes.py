"""The vehicles' routes, and the events that the routes cause, without ROS and a cluster."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import yaml
from demandops.detect import rule_file
from rosbags.rosbag2 import StoragePlugin

from examples.experiment import paper
from examples.experiment.full import fleet, routes
from examples.experiment.full.bags import bag_tracks
from examples.experiment.full.process_runner import path_in_pod
from examples.experiment.full.routes import Way
from examples.experiment.full.rules import Event, Near, Pose, causes, events_of, predicted
from tests.kit.detection import write_bag

NEAR = Near.read()
GAP_S = 10.0


def drive(all_routes: tuple[Way, ...], until: float) -> list[Pose]:
    return predicted(all_routes, NEAR, until)


def events(seed: int) -> list[Event]:
    return events_of(drive(routes.four(seed, GAP_S), 95), NEAR, 95)


def order(seed: int) -> list[str]:
    return [str(event) for event in events(seed)]


def test_seed_0_has_the_paper_s_distance_and_order_of_events() -> None:
    assert NEAR.start == routes.RADIUS_M == 84
    assert NEAR.start < NEAR.stop < routes.FAR_M
    assert order(0) == list(paper.STEPS)


def test_with_any_seed_each_vehicle_joins_and_leaves_once_in_another_order() -> None:
    for seed in range(1, 7):
        found = events(seed)
        assert sorted(map(str, found)) == sorted(paper.STEPS)
        gaps = [later.at - event.at for event, later in itertools.pairwise(found)]
        assert min(gaps) > GAP_S / 4
    assert len({tuple(order(seed)) for seed in range(7)}) > 5


def test_vehicles_drive_in_from_one_road_and_out_on_another() -> None:
    for route in routes.four(3, GAP_S):
        assert route.arm_in != route.arm_out
        assert route.distance(route.enters) == pytest.approx(84)
        assert route.distance((route.enters + route.leaves) / 2) == pytest.approx(0)


@pytest.mark.parametrize("vehicle", routes.VEHICLES)
def test_a_vehicle_vanishes_while_nothing_else_happens(vehicle: str) -> None:
    """No vehicle enters or leaves within a second of the time at which the vehicle vanishes."""
    for seed in range(30):
        silent = routes.vanishing(routes.four(seed, GAP_S), vehicle)
        (moment,) = (route.vanishes for route in silent if route.vehicle == vehicle)
        others = [at for route in silent for at in (route.enters, route.leaves)]
        assert min(abs(moment - at) for at in others) > 1


def test_a_vehicle_that_falls_silent_leaves_after_the_time_out_because_of_its_last_pose() -> None:
    silent = routes.vanishing(routes.one(0, GAP_S), "vehicle00")
    joins, leaves = events_of(drive(silent, 60), NEAR, 60)
    assert (joins.joins, leaves.joins) == (True, False)
    assert leaves.at == pytest.approx(2.5 * GAP_S + NEAR.timeout, abs=0.21)
    expected = pytest.approx([GAP_S, 2.5 * GAP_S], abs=0.11)
    assert causes(drive(silent, 60), NEAR, 60) == expected


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_recorded_poses_give_the_same_events_when_they_are_played(
    tmp_path: Path, plugin: StoragePlugin
) -> None:
    silent = routes.vanishing(routes.four(3, GAP_S), "vehicle01")
    poses = drive(silent, 95)
    write_bag(tmp_path / "bag", ((p.at + 1e9, p.vehicle, p.x, p.y) for p in poses), plugin)
    played = events_of(drive(bag_tracks(tmp_path / "bag", NEAR), 110), NEAR, 110)
    recorded = events_of(poses, NEAR, 95)
    assert [str(event) for event in played] == [str(event) for event in recorded]
    assert [event.at for event in played] == pytest.approx(
        [event.at + routes.LEAD_S for event in recorded], abs=0.7
    )


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


def test_the_rules_for_zenoh_are_valid_and_keep_all_names_of_topics() -> None:
    text = fleet.rules("zenoh")
    assert rule_file.read(text, "rules.yaml").rules
    for rule in yaml.safe_load(text)["rules"]:
        for connection in rule["deploymentRequest"]["connections"]:
            assert connection["source_topics"] == connection["target_topics"]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("params_file:=/config/params.yaml", "params_file:=/pod/c/params.yaml"),
        ("/config", "/pod/c"),
        ("/configuration/x", "/configuration/x"),
        ("/other/config/x", "/other/config/x"),
        ("/config/deep/x", "/pod/d/x"),
        ("/tmp", "/tmp/pod/t"),
        ("/config/x:/tmp/y", "/pod/c/x:/tmp/pod/t/y"),
        ("/params/x", "/tmp/pod/i/x"),
    ],
)
def test_a_path_below_a_mount_becomes_one_of_this_machine(text: str, found: str) -> None:
    mounts = {"/config": "/pod/c", "/config/deep": "/pod/d", "/tmp": "/tmp/pod/t"}
    assert path_in_pod(text, mounts | {"/params": "/tmp/pod/i"}) == found
