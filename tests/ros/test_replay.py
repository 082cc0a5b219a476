"""Rules on a recorded bag: the demands that they would make, and bags that cannot be read."""

from __future__ import annotations

import json
import sqlite3
import sys
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

from tests.kit.cli import Run, process
from tests.kit.detection import POSE, SOURCES, rule, text_of, write_bag
from tests.kit.goals import EXPERIMENT

RULES = Path(__file__).parents[2] / "examples" / "experiment" / "rules.yaml"
STATION = (-5352.679, -3363.067)
START_S = 1_700_000_000
AWAY = {
    "vehicle00": {0.0: 100, 1.0: 84.1, 2.0: 84, 3.0: 89.9, 4.0: 90.1},
    "vehicle01": {0.5: 80, 6.0: 200},  # silent for more than 5 s
    "vehicle03": {1.5: 80, 6.0: 80, 9.0: 85},  # silent for less
}
"""The distances of vehicles from the station in metres, by time."""
EVENTS = [
    (0.5, "vehicle01", "start"),
    (1.5, "vehicle03", "start"),
    (2.0, "vehicle00", "start"),
    (4.0, "vehicle00", "stop"),
    (5.5, "vehicle01", "stop"),
]


def record(path: Path, plugin: StoragePlugin = StoragePlugin.MCAP) -> None:
    """Record a bag of the poses, and of a topic that no rule reads."""
    poses = [
        (START_S + time, vehicle, STATION[0] + away * 0.6, STATION[1] - away * 0.8)
        for vehicle, distances in AWAY.items()
        for time, away in distances.items()
    ]
    write_bag(path, sorted(poses), plugin, [(START_S, "/vehicles/tram/pose", "ding")])


def test_a_replay_needs_no_ros(tmp_path: Path) -> None:
    record(tmp_path / "bag")
    without = "import sys; sys.modules['rclpy'] = None; from demandops.cli.main import main; main()"
    for further, code, told in (
        (["--replay", str(tmp_path / "bag")], 0, "vehicle00"),
        ([], 1, "detect needs rclpy, which is not installed"),
    ):
        ran = process(sys.executable, "-c", without, "detect", RULES, *further)
        assert (ran.code, told in ran.out + ran.err) == (code, True), ran.err


def test_a_bag_gives_the_demands_of_its_poses(demandops: Run, tmp_path: Path) -> None:
    plot = tmp_path / "plot.svg"
    record(tmp_path / "bag")
    options = ("--replay", tmp_path / "bag", "--plot", plot, "--output", "json")
    ran = demandops("detect", RULES, *options)
    assert ran.code == 0
    assert ran.err.startswith("warning: /vehicles/tram/pose is not read, because its type is std_")
    data = ran.json()
    told = [(one["second"], one["entities"][0], one["change"]) for one in data["events"]]
    assert told == EVENTS
    assert data["messages"] == sum(map(len, AWAY.values()))
    joins: dict[str, Any] = {}
    for file in EXPERIMENT[:4]:
        goal = yaml.safe_load(file.read_text())
        joins[goal["connections"][0]["source_node_id"]] = {**goal, "shutdown": False}
    for one in data["events"]:
        if one["change"] == "start":
            assert {**one["goal"], "shutdown": False} == joins[one["entities"][0]]
    bars = ElementTree.parse(plot).getroot().findall("{*}rect")[1:]  # noqa: S314
    assert len(bars) == 3


EGO = "perception_msgs/msg/EgoData"
EGO_FIELDS = "std_msgs/Header header\nperception_msgs/ObjectState state\n"
STATE_FIELDS = "string model\nfloat64[] continuous_state\nbyte kind\n"


def test_a_bag_is_read_with_the_message_definitions_that_it_contains(
    demandops: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without definitions in the bag, those of an installed package are taken."""
    types = get_typestore(Stores.ROS2_KILTED)
    types.register(get_types_from_msg(STATE_FIELDS, "perception_msgs/msg/ObjectState"))
    types.register(get_types_from_msg(EGO_FIELDS, EGO))
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topic = writer.add_connection("/vehicles/vehicle01/pose", EGO, typestore=types)
        odd = {"msgdef": "no $$ definition\n", "rihs01": "RIHS01_" + "0" * 64}
        writer.add_connection("/odd", "odd_msgs/msg/Odd", **odd)  # that no rule reads
        # the last message says, by the byte 200, that its position is not known
        for tick, away in enumerate((100.0, 80.0, 89.0, 95.0, 80.0)):
            place = numpy.array([STATION[0] + away, STATION[1], 0.0])
            kind = 200 - 256 if tick == 4 else 0
            state = types.types["perception_msgs/msg/ObjectState"]("ego", place, kind)
            stamp = types.types["builtin_interfaces/msg/Time"](0, 0)
            ego = types.types[EGO](types.types["std_msgs/msg/Header"](stamp, "map"), state)
            writer.write(topic, (START_S + tick) * 10**9, types.serialize_cdr(ego, EGO))
    rules = tmp_path / "rules.yaml"
    source = f"type: {EGO}\n    unavailable: {{state.kind: 200}}"
    rules.write_text(RULES.read_text().replace(f"type: {POSE}", source))
    messages = tmp_path / "share" / "perception_msgs" / "msg"
    messages.mkdir(parents=True)
    (messages / "EgoData.msg").write_text(EGO_FIELDS)
    (messages / "ObjectState.msg").write_text(STATE_FIELDS)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    for statement in ("", "DELETE FROM message_definitions"):  # as before ROS 2 Iron
        with sqlite3.connect(tmp_path / "bag" / "bag.db3") as database:
            database.execute(statement)
        ran = demandops("detect", rules, "--replay", tmp_path / "bag", "--output", "json")
        told = [(one["second"], one["entities"], one["change"]) for one in ran.json()["events"]]
        assert told == [(1.0, ["vehicle01"], "start"), (3.0, ["vehicle01"], "stop")]


def test_a_bag_that_is_unreadable_or_lacks_the_topics_of_the_rules_is_refused(
    demandops: Run, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"\x89MCAP0\r\n\x01" + b"\xff" * 40)
    write_bag(tmp_path / "empty", [], texts=[])
    for bag in (tmp_path, broken, tmp_path / "empty"):
        ran = demandops("detect", RULES, "--replay", bag)
        assert ran.code == 1
        assert ran.err.startswith(f"error: {bag}: is not a bag that can be read: ")
    record(tmp_path / "bag")
    rules = tmp_path / "rules.yaml"
    rules.write_text(RULES.read_text().replace("/vehicles/{", "/cars/{"))
    ran = demandops("detect", rules, "--replay", tmp_path / "bag", "--output", "json")
    (fault,) = json.loads(ran.out)["faults"]
    lacks, _, has = fault["message"].partition("; it has ")
    assert lacks.endswith(f"no topic that the rules read: /cars/{{entity}}/pose ({POSE})")
    assert has.startswith("/vehicles/tram/pose (std_msgs/msg/String), ")


def test_a_rule_without_an_event_is_told_with_what_was_seen(demandops: Run, tmp_path: Path) -> None:
    record(tmp_path / "bag")
    point = dict(zip("xy", STATION, strict=True))
    far = {"source": "cars", "point": point | {"x": 3000.0}, "start": 5, "stop": 6}
    rules = {
        "named": {"near": far, "entities": ["car*"]},
        "far": {"near": far},
        "many": {"count": {"source": "cars", "point": point, "radius": 9, "start": 9, "stop": 0}},
        "close": {"together": {"source": "cars", "start": 0.1, "stop": 0.2}, "dwell": "1h"},
    }
    sources = {"cars": SOURCES["cars"] | {"topic": "/vehicles/{entity}/pose"}}
    file = tmp_path / "rules.yaml"
    file.write_text(text_of(*(rule(name, **rules[name]) for name in rules), sources=sources))
    ran = demandops("detect", file, "--replay", tmp_path / "bag")
    seen = "entities seen: vehicle00, vehicle01, vehicle03"
    assert [line for line in ran.out.splitlines() if "had no event" in line] == [
        f"rule 'named' had no event: {seen}; none matches car*",
        "rule 'far' had no event: nearest: vehicle01 at 8,234 m (start: 5, dwell: 0s)",
        "rule 'many' had no event: nearest: vehicle01 at 80 m (start: 9, dwell: 0s)",
        f"rule 'close' had no event: {seen}; its condition never held for 1h",
    ]


def test_a_damaged_end_of_a_bag_is_told_without_a_count(capfd: pytest.CaptureFixture[str]) -> None:
    file = rule_file.read(RULES.read_text(), str(RULES))
    lost = {(REST_OF_BAG, "cannot be read: damaged"): 1, ("/a", "cannot be decoded"): 2}
    show(Replay("bag", file, (0.0, 1.0), ["/a"], left_out=lost), "json")
    assert capfd.readouterr().err == (
        "warning: the rest of the bag is left out: cannot be read: damaged\n"
        "warning: /a: 2 messages are left out: cannot be decoded\n"
    )
