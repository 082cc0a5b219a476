"""The event detector as a process: vehicles publish their poses, and the detector sends demands.

The experiment in full (`examples/experiment/full`) drives the paper's vehicles by simulated time.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from demandops.detect.rule_file import read
from demandops_ros.detector.detector_node import read_bookkeeping
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import qos_profile_sensor_data

from tests.kit.cli import Run
from tests.kit.detection import POSE, text_of
from tests.kit.goals import put
from tests.kit.live import Step, heard_live, told
from tests.kit.repo import git
from tests.kit.ros import Client, Serve, Servers
from tests.ros.test_following import Diagnostics

NEAR, AWAY = 50.0, 91.0


def rules_of(**fields: Any) -> str:
    """Return rules by which each vehicle near the origin demands an application."""
    goal = put("near/{entity}", "{entity}", topic=("/vehicles/{entity}/ego_data", "{entity}"))
    demand = {name: value for name, value in goal.items() if name != "kind"}
    demand["applications"][0]["id"] = "edge/near-{entity}"
    near = {"source": "vehicles", "point": {"x": 0.0, "y": 0.0}, "start": 84, "stop": 90}
    rule = {"name": "near", "near": near, "demand": demand, "retry": "1s"}
    sources = {"vehicles": {"topic": "/vehicles/{entity}/pose", "type": POSE, "timeout": "1h"}}
    return text_of(rule | fields, sources=sources)


def test_who_comes_near_demands_until_it_leaves_and_rules_are_reloaded(
    serve: Serve, servers: Servers, client: Client, tmp_path: Path
) -> None:
    served, rules = serve(), tmp_path / "rules.yaml"
    rules.write_text(rules_of().replace("node: edge", "node: egde"))
    renamed = ("--ros-args", "-r", "__node:=watcher")  # as the launch file does
    detecting = servers.run(served.state_repo, "detect", str(rules), *renamed)
    heard = Diagnostics(client)
    away, poses = {"vehicle00": NEAR, "vehicle01": NEAR}, {}
    for vehicle in away:
        topic = f"/vehicles/{vehicle}/pose"
        poses[vehicle] = client.node.create_publisher(PoseStamped, topic, 10)

    def drive() -> None:
        for vehicle, publisher in poses.items():
            message = PoseStamped()
            message.pose.position.x = away[vehicle]
            publisher.publish(message)

    client.node.create_timer(0.1, drive)

    def warns_of(part: str) -> Callable[[], bool]:
        return lambda: heard.is_at(f"demandops_detector: {part}", DiagnosticStatus.WARN)

    def held() -> set[str]:
        return {*served.bookkeeping().get("demands", {})}

    client.wait(lambda: served.log.read_text().count("unknown-node") > 4)  # it tries again
    client.wait(lambda: detecting.log.read_text().count("unknown-node") > 1)  # also of the other
    assert detecting.log.read_text().count("unknown-node") == 2, "each refusal is logged once"
    names = ["demandops_detector_client", "watcher"]
    client.wait(lambda: {*names} <= {*client.node.get_node_names()})
    client.wait(warns_of("demands"))
    rules.write_text(rules_of(near={"source": "vehicle"}))
    fault = "rules.yaml:10: rules[0].near.stop: is missing; add it; the last valid"
    client.wait(lambda: fault in detecting.log.read_text())
    client.wait(warns_of("rules"))
    rules.write_text(rules_of())
    client.wait(lambda: held() == {"near/vehicle00", "near/vehicle01"})
    away["vehicle00"] = AWAY
    client.wait(lambda: held() == {"near/vehicle01"})
    assert detecting.stop() == 0
    detecting = servers.run(served.state_repo, "detect", str(rules))
    client.wait(lambda: "demands booked before the start: 1" in detecting.log.read_text())
    away["vehicle01"] = AWAY
    client.wait(lambda: held() == set())
    # what its next publisher sends is heard by no reliable subscription
    client.node.destroy_publisher(poses["vehicle01"])
    topic, qos = "/vehicles/vehicle01/pose", qos_profile_sensor_data
    quiet = PublisherEventCallbacks(use_default_callbacks=False)
    lossy = client.node.create_publisher(PoseStamped, topic, qos, event_callbacks=quiet)
    poses["vehicle01"], away["vehicle01"] = lossy, NEAR
    client.wait(lambda: held() == {"near/vehicle01"})
    assert detecting.stop() == 0
    form = "--format=%(trailers:key=Operation,valueonly)"
    log = git(served.state_repo, "log", "--reverse", form, "main").split()
    assert [word for word in log if word != "renew"] == [
        "init",
        *["put"] * 2,
        *["release"] * 2,
        "put",
    ]


def test_bookkeeping_that_cannot_be_read_is_told_and_is_not_used(
    caplog: pytest.LogCaptureFixture,
) -> None:
    file = read(rules_of(), "rules.yaml")
    odd = ["", "null", "[]", "{", "[" * 100_000, '{"demands": []}', '{"demands": {"a": 1}}']
    assert [read_bookkeeping(text, file) for text in odd] == [None] * len(odd)
    assert read_bookkeeping('{"demands": {}}', file) == {"demands": {}}
    assert [record.levelname for record in caplog.records] == ["WARNING"] * len(odd)
    assert all("the bookkeeping cannot be read (" in line for line in caplog.messages)


SITE, TF = "site", "tf2_msgs/msg/TFMessage"


def frame(child: str, parent: str, x: float) -> dict[str, Any]:
    """Return a message of /tf: the origin of ``child`` is at ``x`` in ``parent``, turned by 90°."""
    rotation = {"x": 0.0, "y": 0.0, "z": 0.5**0.5, "w": 0.5**0.5}
    transform = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": rotation}
    head = {"header": {"frame_id": parent}, "child_frame_id": child}
    return {"transforms": [head | {"transform": transform}]}


def test_positions_in_frames_of_tf_give_the_same_events_live_and_from_a_bag(
    demandops: Run, tmp_path: Path, ros_domain: int
) -> None:
    rules = tmp_path / "rules.yaml"
    point = {"x": 980.0, "y": 0.0}
    near = {"source": "vehicles", "point": point, "start": 84, "stop": 90}
    rules.write_text(rules_of(near=near) + "map: {frame: map}\n")

    def pose(vehicle: str, frame: str) -> Step:
        fields = {"header": {"frame_id": frame}, "pose": {"position": {"x": 20.0}}}
        return f"/vehicles/{vehicle}/pose", POSE, fields

    steps: list[Step] = [pose("v1", "v1/base")] * 3  # nothing tells where that is
    steps += [("/tf_static", TF, frame(SITE, "map", 1000.0)), pose("v1", "v1/base")]
    for away in (100.0, 80.0, 89.0, 91.0, 80.0):
        steps += [("/tf", TF, frame("v1/base", SITE, away)), pose("v1", "v1/base")]
        steps += [pose("v2", "v2/base")]
    log = heard_live(rules, steps, 3, ros_domain)
    left_out = "in the frame 'v{}/base' are left out, because nothing on /tf or /tf_static leads"
    assert [log.count(left_out.format(number)) for number in (1, 2)] == [1, 1]
    # the x of the site is the y of the map, and ahead of the base is where x of the map falls
    events = [f"rule near: v1 is {away:.1f} m from the area" for away in (80, 91, 80)]
    assert told(log) == events
    replayed = demandops("detect", rules, "--replay", rules.with_name("bag"), "--output", "json")
    assert [f"rule {one['rule']}: {one['reason']}" for one in replayed.json()["events"]] == events
