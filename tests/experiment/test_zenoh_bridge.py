"""The stand-in for the Zenoh bridge carries what its configuration allows, and nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from std_msgs.msg import String

from tests.e2e.rig.net import free_port
from tests.experiment.standins import image
from tests.kit.generator import wait_until
from tests.kit.limits import PATIENCE_S
from tests.kit.ros import reserved


@pytest.fixture
def nodes() -> Iterator[dict[str, Any]]:
    """Yield the ROS nodes `vehicle` and `edge`, each in a ROS domain of its own."""
    with reserved() as vehicle, reserved() as edge:
        made = {}
        for name, domain in (("vehicle", vehicle), ("edge", edge)):
            context = rclpy.Context()
            rclpy.init(context=context, domain_id=domain)
            made[name] = rclpy.create_node(name, context=context)
        yield made
        for node in made.values():
            node.destroy_node()
            node.context.try_shutdown()


def test_allowed_topics_cross_between_ros_domains_and_no_other(
    nodes: dict[str, Any], tmp_path: Path
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    ends = {"vehicle": ("connect", "publishers"), "edge": ("listen", "subscribers")}
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    program, running = image(tmp_path) / "zenoh-bridge-ros2dds", []
    for name, (side, direction) in ends.items():
        plugin = {
            "nodename": f"zenoh_{name}",
            "domain": nodes[name].context.get_domain_id(),
            "allow": {direction: ["^/allowed$"]},
        }
        config = {"mode": "router", side: {"endpoints": [endpoint]}, "plugins": {"ros2dds": plugin}}
        config["scouting"] = {"multicast": {"enabled": False}}
        file = tmp_path / f"{name}.json5"
        file.write_text(json.dumps(config))
        running.append(subprocess.Popen([program, "-c", str(file)], env=environment))
    senders = {
        topic: nodes["vehicle"].create_publisher(String, topic, 10)
        for topic in ("/allowed", "/other")
    }
    heard: list[str] = []
    for topic in senders:
        nodes["edge"].create_subscription(String, topic, lambda got: heard.append(got.data), 10)
    executor = rclpy.executors.SingleThreadedExecutor(context=nodes["edge"].context)
    executor.add_node(nodes["edge"])

    def has_arrived() -> bool:
        for topic, sender in senders.items():
            sender.publish(String(data=topic))
        executor.spin_once(timeout_sec=0.1)
        return len(heard) > 3

    try:
        wait_until(has_arrived, "messages cross")
    finally:
        executor.shutdown(timeout_sec=1)
        for process in running:
            process.terminate()
    assert [process.wait(PATIENCE_S) for process in running] == [0, 0]
    assert set(heard) == {"/allowed"}
