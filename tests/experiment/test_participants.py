"""The program `participants` stops the vehicles at given times, and lets them drive on."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.experiment import fleet, routes
from tests.experiment.participants import Plan
from tests.experiment.rules import poses_in
from tests.kit.generator import wait_until
from tests.kit.limits import PATIENCE_S
from tests.kit.ros import reserved


@pytest.mark.parametrize("poses_only", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_the_vehicles_stand_until_they_may_drive_on(tmp_path: Path, poses_only: bool) -> None:
    record, ways = tmp_path / "poses.jsonl", routes.one(0, 1.0)
    with reserved() as domain:
        domains = dict.fromkeys(fleet.NODES, domain)
        cloud = fleet.station_cloud("mqtt")
        plan = Plan(ways, (100.0, 200.0), domains, 0, str(record), cloud, poses_only)
        plan.write(tmp_path / "plan.json")
        command = [sys.executable, "-m", "tests.experiment.participants", tmp_path / "plan.json"]
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert process.stdin is not None and process.stdout is not None

        def drive_until(moment: float) -> None:
            process.stdin.write(f"{moment}\n")
            process.stdin.flush()

        def stands_at(moment: float) -> bool:
            x, y = ways[0].position(moment)
            last = poses_in(record)[-3:]
            return [(p.x, p.y) for p in last] == [(100.0 + x, 200.0 + y)] * 3

        assert json.loads(process.stdout.readline()) == {"ready": True}
        wait_until(lambda: record.read_text().count("\n") > 3, "the vehicles send while at rest")
        drive_until(1.5)
        assert "set_off" in json.loads(process.stdout.readline())
        wait_until(lambda: stands_at(1.5), "the vehicles stand")
        drive_until(2.0)
        wait_until(lambda: stands_at(2.0), "the vehicles stand again")
        process.send_signal(signal.SIGTERM)
        said = json.loads(process.stdout.readline())
        assert process.wait(PATIENCE_S) == 0
    assert said["held"] > 0
    topics = {"/vehicles/vehicle00/pose"}
    if not poses_only:
        topics |= {"/vehicles/vehicle00/ego_data", "/vehicles/vehicle00/drivers/lidar/pointcloud"}
        topics |= {cloud}
    assert said["sent"].keys() == topics
