"""On a recorded bag, rules give the same demands as a plain script gives on the same poses."""

from __future__ import annotations

import json
import random
from math import cos, hypot, sin
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy
import pytest
import yaml
from demandops.detect import rule_file
from demandops_ros.detector.replay import REST_OF_BAG, Replay, show
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.kit.bag import write_bag
from tests.kit.cli import Run
from tests.kit.detection import POSE
from tests.kit.goals import EXPERIMENT

RULES = Path(__file__).parents[2] / "examples" / "experiment" / "rules.yaml"
STATION = (-5352.679, -3363.067)
VEHICLES = ("vehicle00", "vehicle01", "vehicle02", "vehicle03")
START_S = 1_700_000_000
Poses = list[tuple[float, str, float, float]]


def driven(seed: int) -> Poses:
    """Return the poses of vehicles that pass the station on straight lines, sorted by time.

    Each vehicle reports ten poses a second, but may be silent for a while. The seed decides about
    lines, speeds and silences.
    """
    chance, poses = random.Random(seed), []
    for vehicle in VEHICLES:
        heading, beside = chance.uniform(0, 6.28), chance.uniform(-90, 90)
        speed, first = chance.uniform(8, 20), chance.uniform(0, 15)
        silent_from, silent_for = chance.uniform(5, 40), chance.choice([0, 3, 8, 60])
        for tick in range(400):
            time = first + tick / 10
            if silent_from <= time < silent_from + silent_for:
                continue
            along = speed * (time - first) - 250
            x = STATION[0] + along * cos(heading) - beside * sin(heading)
            y = STATION[1] + along * sin(heading) + beside * cos(heading)
            poses.append((time, vehicle, x, y))
    return sorted(poses)


def record(path: Path, poses: Poses, plugin: StoragePlugin) -> None:
    later = ((START_S + time, vehicle, x, y) for time, vehicle, x, y in poses)
    write_bag(path, later, plugin, [(START_S, "/vehicles/tram/pose", "ding")])


def plainly(poses: Poses) -> list[tuple[float, str, str]]:
    """Return the times at which vehicles enter (`start`) and leave (`stop`), by a plain script.

    A vehicle enters within 84 m, and leaves beyond 90 m or after 5 s of silence.
    """
    found, end = [], poses[-1][0]
    for vehicle in VEHICLES:
        is_near, heard = False, 0.0
        for time, _, x, y in [pose for pose in poses if pose[1] == vehicle]:
            away = hypot(x - STATION[0], y - STATION[1])
            if is_near and time - heard >= 5:
                found.append((heard + 5, vehicle, "stop"))
                is_near = False
            if not is_near and away <= 84:
                found.append((time, vehicle, "start"))
                is_near = True
            elif is_near and away > 90:
                found.append((time, vehicle, "stop"))
                is_near = False
            heard = time
        if is_near and end - heard >= 5:
            found.append((heard + 5, vehicle, "stop"))
    return sorted(found)


@pytest.mark.parametrize("plugin", StoragePlugin)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_bag_gives_the_demands_of_a_plain_script(
    demandops: Run, tmp_path: Path, seed: int, plugin: StoragePlugin
) -> None:
    poses, plot = driven(seed), tmp_path / "plot.svg"
    record(tmp_path / "bag", poses, plugin)
    options = ("--replay", tmp_path / "bag", "--plot", plot, "--output", "json")
    ran = demandops("detect", RULES, *options)
    assert ran.code == 0
    assert ran.err.startswith("warning: /vehicles/tram/pose is not read, because its type is std_")
    data = ran.json()
    told = [(one["second"], one["entities"][0], one["change"]) for one in data["events"]]
    expected = plainly(poses)
    assert [(who, change) for _, who, change in told] == [(w, c) for _, w, c in expected]
    assert [one[0] for one in told] == pytest.approx([time for time, *_ in expected], abs=0.002)
    assert data["messages"] == len(poses)
    joins: dict[str, Any] = {}
    for file in EXPERIMENT[:4]:
        goal = yaml.safe_load(file.read_text())
        joins[goal["connections"][0]["source_node_id"]] = {**goal, "shutdown": False}
    for one in data["events"]:
        if one["change"] == "start":
            assert {**one["goal"], "shutdown": False} == joins[one["entities"][0]]
    drawn = ElementTree.parse(plot).getroot()  # noqa: S314
    bars = drawn.findall("{*}rect")[1:]
    assert len(bars) == sum(change == "start" for _, _, change in expected)


EGO = "perception_msgs/msg/EgoData"
EGO_FIELDS = "std_msgs/Header header\nperception_msgs/ObjectState state\n"
STATE_FIELDS = "string model\nfloat64[] continuous_state\n"


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_bag_is_read_with_the_message_definitions_that_it_contains(
    demandops: Run, tmp_path: Path, plugin: StoragePlugin
) -> None:
    """The package of EgoData is not installed, so the test writes definitions into the bag."""
    types = get_typestore(Stores.ROS2_KILTED)
    types.register(get_types_from_msg(STATE_FIELDS, "perception_msgs/msg/ObjectState"))
    types.register(get_types_from_msg(EGO_FIELDS, EGO))
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        topic = writer.add_connection("/vehicles/vehicle01/pose", EGO, typestore=types)
        for tick, away in enumerate((100.0, 80.0, 89.0, 95.0)):
            place = numpy.array([STATION[0] + away, STATION[1], 0.0])
            state = types.types["perception_msgs/msg/ObjectState"]("ego", place)
            stamp = types.types["builtin_interfaces/msg/Time"](0, 0)
            ego = types.types[EGO](types.types["std_msgs/msg/Header"](stamp, "map"), state)
            writer.write(topic, (START_S + tick) * 10**9, types.serialize_cdr(ego, EGO))
    rules = tmp_path / "rules.yaml"
    rules.write_text(RULES.read_text().replace(POSE, EGO))
    ran = demandops("detect", rules, "--replay", tmp_path / "bag", "--output", "json")
    told = [(one["second"], one["entities"], one["change"]) for one in ran.json()["events"]]
    assert told == [(1.0, ["vehicle01"], "start"), (3.0, ["vehicle01"], "stop")]


def test_a_bag_that_is_unreadable_or_lacks_the_topics_of_the_rules_is_refused(
    demandops: Run, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"\x89MCAP0\r\n\x01" + b"\xff" * 40)
    for bag in (tmp_path, broken):
        ran = demandops("detect", RULES, "--replay", bag)
        assert ran.code == 1
        assert ran.err.startswith(f"error: {bag}: is not a bag that can be read: ")
    record(tmp_path / "bag", [(0.0, "vehicle00", 0.0, 0.0)], StoragePlugin.MCAP)
    rules = tmp_path / "rules.yaml"
    rules.write_text(RULES.read_text().replace("/vehicles/{", "/cars/{"))
    ran = demandops("detect", rules, "--replay", tmp_path / "bag", "--output", "json")
    (fault,) = json.loads(ran.out)["faults"]
    lacks, _, has = fault["message"].partition("; it has ")
    assert lacks.endswith(f"no topic that the rules read: /cars/{{entity}}/pose ({POSE})")
    assert has.startswith("/vehicles/tram/pose (std_msgs/msg/String), ")


def test_a_damaged_end_of_a_bag_is_told_without_a_count(capfd: pytest.CaptureFixture[str]) -> None:
    file = rule_file.read(RULES.read_text(), str(RULES))
    lost = {(REST_OF_BAG, "cannot be read: damaged"): 1, ("/a", "cannot be decoded"): 2}
    show(Replay("bag", file, (0.0, 1.0), ["/a"], left_out=lost), "json")
    assert capfd.readouterr().err.splitlines() == [
        "warning: the rest of the bag is left out: cannot be read: damaged",
        "warning: /a: 2 messages are left out: cannot be decoded",
    ]
