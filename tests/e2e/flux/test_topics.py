"""A subscriber of the reference's topics receives what the programs in the pods publish."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from std_msgs.msg import String

from tests.e2e.common import publisher
from tests.e2e.common.expected import DETECTION, FUSION, after
from tests.e2e.common.ros import Client
from tests.e2e.rig import launch

from .world import World

OF_THE_REFERENCE = {
    "/station00_local_objectlist": "od_edge_station00",
    "/vehicle00_local_objectlist": "od_edge_vehicle00",
    "/edge_object_detection_fusion_global_objectlist": FUSION.replace("-", "_"),
    "/edge_object_detection_fusion_global_trajectories": FUSION.replace("-", "_"),
}
"""Topics with their nodes, as object_detection_fusion_app.py of application_manager names them."""


@pytest.fixture
def programs(world: World, ros_domain: int, tmp_path: Path) -> Iterator[None]:
    """Run the commands of the first step's pods on this machine, in the tests' ROS domain."""
    world.step(1, after(1))
    setup = tmp_path / "install" / "setup.bash"
    setup.parent.mkdir()
    setup.write_text(f'PATH="{tmp_path}:$PATH"\n')
    ros2 = tmp_path / "ros2"
    ros2.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{publisher.__file__}" "$@"\n')
    ros2.chmod(0o755)
    started = []
    for name in (*DETECTION.values(), FUSION):
        pod = world.domain.get("Deployment", name)["spec"]["template"]["spec"]
        container = pod["containers"][0]
        given = {one["name"]: one["value"] for one in container["env"]}
        command = launch.command(*container["command"], *container["args"])
        environment = os.environ | given | {"ROS_DOMAIN_ID": str(ros_domain)}
        started.append(subprocess.Popen(command, cwd=tmp_path, env=environment))
    yield
    for process in started:
        process.kill()
        process.wait()


def test_a_subscriber_of_the_reference_hears_every_output(programs: None, client: Client) -> None:
    heard: dict[str, str] = {}
    for topic in OF_THE_REFERENCE:
        client.node.create_subscription(
            String, topic, lambda message, topic=topic: heard.setdefault(topic, message.data), 10
        )
    client.wait(lambda: heard.keys() >= OF_THE_REFERENCE.keys())
    assert heard == OF_THE_REFERENCE
