"""A node as people run it, and a client: real processes, real rclpy, a ROS graph of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.kit.repo import init
from tests.kit.ros import Client, Serve, Served, reserved


@pytest.fixture(scope="session")
def ros_domain() -> Iterator[int]:
    """A ROS domain for this test process, so that nothing else answers."""
    with reserved() as domain:
        yield domain


@pytest.fixture
def serve(tmp_path: Path, data_home: Path, ros_domain: int) -> Iterator[Serve]:
    """Start nodes, and end those that a test leaves running."""
    started: list[Served] = []
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(ros_domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path / "ros-log"),
    }

    def start(state_repo: str | None = None, *args: str) -> Served:
        if state_repo is None:
            state_repo = str(init(tmp_path / "state.git"))
        log = tmp_path / f"node-{len(started)}.log"
        command = [sys.executable, "-m", "demandops.cli.main", "serve", "--state-repo", state_repo]
        with log.open("w") as sink:
            process = subprocess.Popen(
                [*command, *args], env=environment, stdout=sink, stderr=subprocess.STDOUT, text=True
            )
        started.append(Served(process, state_repo, log, environment))
        return started[-1]

    yield start
    for served in started:
        if served.process.poll() is None:
            served.process.kill()
            served.process.wait(10)


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    made = Client(ros_domain)
    yield made
    made.close()
