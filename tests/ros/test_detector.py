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
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped

from tests.kit.detection import POSE, text_of
from tests.kit.goals import put
from tests.kit.repo import git
from tests.kit.ros import Client, Serve, Servers

NEAR, AWAY = 50.0, 91.0


def rules_of(**fields: Any) -> str:
    """Return rules by which each vehicle near the origin demands an application."""
    goal = put("near/{entity}", "{entity}", topic=("/vehicles/{entity}/ego_data", "{entity}"))
    demand = {name: value for name, value in goal.items() if name != "kind"}
    demand["applications"][0]["id"] = "edge/near-{entity}"
    near = {"source": "vehicles", "point": {"x": 0.0, "y": 0.0}, "start": 84, "stop": 90}
    rule = {"name": "near", "near": near, "demand": demand, "retry": "1s"}
    sources = {"vehicles": {"topic": "/vehicles/{entity}/pose", "type": POSE}}
    return text_of(rule | fields, sources=sources)


def test_who_comes_near_demands_until_it_leaves_and_rules_are_reloaded(
    serve: Serve, servers: Servers, client: Client, tmp_path: Path
) -> None:
    served, rules = serve(), tmp_path / "rules.yaml"
    rules.write_text(rules_of().replace("node: edge", "node: egde"))
    renamed = ("--ros-args", "-r", "__node:=watcher")  # as the launch file does
    detecting = servers.run(served.state_repo, "detect", str(rules), *renamed)
    statuses: dict[str, Any] = {}

    def hear(message: Any) -> None:
        statuses.update({status.name: status for status in message.status})

    away, poses = {"vehicle00": NEAR, "vehicle01": NEAR}, {}
    for vehicle in away:
        topic = f"/vehicles/{vehicle}/pose"
        poses[vehicle] = client.node.create_publisher(PoseStamped, topic, 10)
    client.node.create_subscription(DiagnosticArray, "/diagnostics", hear, 10)

    def drive() -> None:
        for vehicle, publisher in poses.items():
            message = PoseStamped()
            message.pose.position.x = away[vehicle]
            publisher.publish(message)

    client.node.create_timer(0.1, drive)

    def warns_of(part: str) -> Callable[[], bool]:
        return lambda: getattr(statuses.get(f"demandops_detector: {part}"), "level", 0) == b"\x01"

    def held() -> set[str]:
        return {*served.bookkeeping().get("demands", {})}

    client.wait(lambda: served.log.read_text().count("unknown-node") > 4)  # it tries again
    assert detecting.log.read_text().count("unknown-node") == 2, "each refusal is logged once"
    names = ["demandops_detector_client", "watcher"]
    client.wait(lambda: {*names} <= {*client.node.get_node_names()})
    client.wait(warns_of("demands"))
    rules.write_text(rules_of(near={"source": "vehicle"}))
    fault = "rules.yaml:9: rules[0].near.stop: is missing; add it; the last valid"
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
    assert detecting.stop() == 0
    form = "--format=%(trailers:key=Operation,valueonly)"
    log = git(served.state_repo, "log", "--reverse", form, "main").split()
    assert [word for word in log if word != "renew"] == ["init", *["put"] * 2, *["release"] * 2]


def test_bookkeeping_that_cannot_be_read_is_told_and_is_not_used(
    caplog: pytest.LogCaptureFixture,
) -> None:
    file = read(rules_of(), "rules.yaml")
    odd = ["", "null", "[]", "{", "[" * 100_000, '{"demands": []}', '{"demands": {"a": 1}}']
    assert [read_bookkeeping(text, file) for text in odd] == [None] * len(odd)
    assert read_bookkeeping('{"demands": {}}', file) == {"demands": {}}
    assert [record.levelname for record in caplog.records] == ["WARNING"] * len(odd)
    assert all("the bookkeeping cannot be read (" in line for line in caplog.messages)
