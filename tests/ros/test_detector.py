"""The event detector as a process: vehicles publish their poses, and the detector sends demands."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from math import inf
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from builtin_interfaces.msg import Time
from demandops.detect.rule_file import read
from demandops_ros.detector.detector_node import read_bookkeeping
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rosgraph_msgs.msg import Clock

from examples.experiment import paper
from tests.kit.detection import POSE, text_of
from tests.kit.goals import put
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import POLICY, GitRepo, git
from tests.kit.rig import wait_until
from tests.kit.ros import Served, Servers

EXAMPLE = Path(__file__).parents[2] / "examples" / "experiment" / "rules.yaml"
_MOST_AHEAD_S = 2.0
"""How many seconds the simulated time may run ahead of the time that the detector has reported.

A vehicle that has been silent for 5 s counts as gone. Without this limit, a vehicle could count as
gone only because the machine is slow.
"""
STATION = (-5352.679, -3363.067)
S, V0, V1, V2, V3 = paper.S, paper.V0, paper.V1, paper.V2, paper.V3


class Fleet:
    """Vehicles that publish their poses ten times a second, while a test waits in `until`.

    They publish a simulated time too, unless ``is_timeless``. It runs ``pace`` times as fast as the
    real one, and never more than `_MOST_AHEAD_S` ahead of what the detector has reported.
    """

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node("fleet", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._publishers: dict[str, Any] = {}
        self._away: dict[str, float] = {}
        self.statuses: dict[str, Any] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)
        self._clock = self.node.create_publisher(Clock, "/clock", 10)
        self.pace, self.is_timeless = 1.0, False
        self._seconds, self._limit, self._since = 1000.0, inf, 0.0
        self.node.create_timer(0.1, self._publish)

    def _hear(self, message: Any) -> None:
        self.statuses |= {status.name: status for status in message.status}
        told = message.header.stamp.sec
        names = {status.name for status in message.status}
        if told > self._since and "demandops_detector: data" in names:
            self._limit = told + _MOST_AHEAD_S

    def drive(self, vehicle: str, away: float) -> None:
        """Place a vehicle at a distance from the station, in metres."""
        if vehicle not in self._publishers:
            topic = f"/vehicles/{vehicle}/pose"
            self._publishers[vehicle] = self.node.create_publisher(PoseStamped, topic, 10)
        self._away[vehicle] = away

    def mute(self, vehicle: str) -> None:
        del self._away[vehicle]

    def forget(self) -> None:
        """Discard the last detector's reports, so that `until` waits for the next detector's."""
        self.statuses.clear()
        self._limit, self._since = inf, self._seconds

    def _publish(self) -> None:
        for vehicle, away in self._away.items():
            message = PoseStamped()
            message.pose.position.x, message.pose.position.y = STATION[0] + away, STATION[1]
            self._publishers[vehicle].publish(message)
        if not self.is_timeless:
            self._seconds += 0.1 * self.pace if self._seconds < self._limit else 0
            nanoseconds = int(self._seconds % 1 * 1e9)
            time_now = Time(sec=int(self._seconds), nanosec=nanoseconds)
            self._clock.publish(Clock(clock=time_now))

    def entities(self) -> str:
        """Return the detector's number of entities, as text; empty before its first report."""
        status = self.statuses.get("demandops_detector: data")
        return {pair.key: pair.value for pair in status.values}["entities"] if status else ""

    def until(self, true: Callable[[], object], what: str) -> None:
        """Publish poses until `true()` holds; fail with `what` in the message."""
        next_look = [0.0]

        def spun() -> object:
            self._executor.spin_once(timeout_sec=0.05)
            began = time.monotonic()
            if began < next_look[0]:
                return False
            found, ended = true(), time.monotonic()
            next_look[0] = ended + max(0.2, ended - began)  # the vehicles publish meanwhile
            return found

        wait_until(spun, what)

    def close(self) -> None:
        self._executor.shutdown(timeout_sec=1)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)


@pytest.fixture
def servers(tmp_path: Path, data_home: Path, ros_domain: int) -> Iterator[Servers]:
    """A starter that runs each command in a new process, as a person does.

    A forked detector could start before the node publishes the newest bookkeeping.
    """
    started = Servers(tmp_path, ros_domain)
    yield started
    started.kill()


@pytest.fixture
def fleet(ros_domain: int) -> Iterator[Fleet]:
    made = Fleet(ros_domain)
    yield made
    made.close()


def commits(served: Served) -> list[str]:
    form = "--format=%(trailers:key=Operation,valueonly)"
    return git(served.state_repo, "log", "--reverse", form, "main").split()


@pytest.mark.nightly
def test_vehicles_that_drive_through_the_intersection_form_the_demands_of_the_paper(
    servers: Servers, fleet: Fleet, new_repo: Callable[[str], Path], tmp_path: Path
) -> None:
    """The detector restarts on the way, which changes no demand. Time is simulated."""
    served = servers.start(str(new_repo("state.git")))

    def detect() -> Served:
        simulated = ("--ros-args", "-p", "use_sim_time:=true")
        return servers.run(served.state_repo, "detect", str(EXAMPLE), *simulated)

    def expect(step: int) -> None:
        def is_so() -> bool:
            return paper.observed(served.bookkeeping()) == paper.expected(step)

        fleet.until(is_so, f"the bookkeeping of step {step}")

    detecting = detect()
    for vehicle in (V0, V1, V2, V3):
        fleet.drive(vehicle, 85)
    for step, vehicle in enumerate((V0, V1, V3, V2), start=1):
        fleet.drive(vehicle, 83)
        expect(step)
    fleet.drive(V2, 89)  # its demand ends only beyond 90 m
    fleet.drive(V0, 91)
    expect(5)
    assert detecting.stop() == 0
    fleet.mute(V1)  # the vehicle leaves while the detector is down
    fleet.forget()
    fleet.is_timeless = True
    detecting = detect()
    fleet.until(lambda: fleet.node.count_subscribers("/demandops/bookkeeping"), "a subscriber")
    fleet.is_timeless = False  # the detector gets the time only after the bookkeeping
    fleet.until(lambda: fleet.entities() == "3", "the others are seen")
    fleet.pace = 10
    expect(6)
    assert "demands booked before the start: 3" in detecting.log.read_text()
    fleet.drive(V2, 91)
    expect(7)
    fleet.mute(V3)
    expect(8)
    assert detecting.stop() == 0
    log = detecting.log.read_text()
    assert "vehicle01 has not been seen since the start" in log
    assert "vehicle03 has been silent for 5 s" in log
    assert commits(served) == ["init", *["join"] * 4, *["shutdown"] * 4]


def rules_of(**fields: Any) -> str:
    """Return rules by which each vehicle near the station demands an application."""
    goal = put("near/{entity}", "{entity}", topic=("/vehicles/{entity}/ego_data", "{entity}"))
    demand = {name: value for name, value in goal.items() if name != "kind"}
    demand["applications"][0]["id"] = "edge/near-{entity}"
    near = {"point": {"x": STATION[0], "y": STATION[1]}, "start": 84, "stop": 90}
    rule = {"name": "near", "near": {"source": "vehicles", **near}, "demand": demand}
    sources = {"vehicles": {"topic": "/vehicles/{entity}/pose", "type": POSE}}
    return text_of(rule | {"retry": "1s"} | fields, sources=sources)


@pytest.mark.nightly
def test_leases_are_renewed_and_rules_are_reloaded_and_a_refused_demand_is_tried_again(
    servers: Servers, fleet: Fleet, new_repo: Callable[[str], Path], tmp_path: Path
) -> None:
    bare = new_repo("state.git")
    policy = yaml.safe_load(GitRepo(bare).files(POLICY)[POLICY])
    policy["domains"][0]["leases"] = {"default": "2s", "slack": "0s"}
    GitRepo(bare).commit({POLICY: yaml.safe_dump(policy)})
    served = servers.start(str(bare))
    rules = tmp_path / "rules.yaml"
    rules.write_text(rules_of().replace("node: edge", "node: egde"))
    renamed = ("--ros-args", "-r", "__node:=watcher")  # as the launch file does
    detecting = servers.run(served.state_repo, "detect", str(rules), *renamed)

    def status(part: str) -> Any:
        return fleet.statuses.get(f"demandops_detector: {part}")

    fleet.drive(V0, 50)
    fleet.until(lambda: "unknown-node" in detecting.log.read_text(), "the demand is refused")
    fleet.until(lambda: served.log.read_text().count("unknown-node") > 2, "more tries")
    assert detecting.log.read_text().count("unknown-node") == 1, "the refusal must be logged once"
    ours = ["demandops_detector_client", "watcher"]
    fleet.until(
        lambda: sorted(name for name in fleet.node.get_node_names() if name in ours) == ours,
        "both nodes are discovered, and only the detector's has the name that it was given",
    )
    fleet.until(
        lambda: "failed and are tried again" in status("demands").message, "it is on /diagnostics"
    )
    rules.write_text(rules_of(near={"source": "vehicle"}))
    fleet.until(lambda: status("rules").level == b"\x01", "an invalid file is reported")
    assert (
        "rules.yaml:9: rules[0].near.stop: is missing; add it; the last valid"
        in detecting.log.read_text()
    )
    rules.write_text(rules_of())
    books = "edge/near-vehicle00"
    fleet.until(lambda: books in json.dumps(served.bookkeeping()), "the new rules are in effect")
    fleet.until(lambda: commits(served).count("renew") >= 3, "its lease is renewed")
    assert books in json.dumps(served.bookkeeping())
    detecting.process.send_signal(signal.SIGKILL)
    detecting.process.wait(PATIENCE_S)
    fleet.until(lambda: commits(served)[-1] == "expire", "its lease ends without the detector")
    assert served.bookkeeping()["services"] == {}


def test_bookkeeping_that_cannot_be_read_is_told_and_is_not_used(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = read(rules_of(), "rules.yaml")
    odd = ["", "null", "[]", "{", "[" * 100_000, '{"demands": []}', '{"demands": {"a": 1}}']
    assert [read_bookkeeping(text, file) for text in odd] == [None] * len(odd)
    assert read_bookkeeping('{"demands": {}}', file) == {"demands": {}}
    assert [record.levelname for record in caplog.records] == ["WARNING"] * len(odd)
    assert all("the bookkeeping cannot be read (" in line for line in caplog.messages)
