"""The services of the tutorial's application do what the tutorial says."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import rclpy
from std_msgs.msg import Int32, String

from tests.kit import pages
from tests.kit.limits import PATIENCE_S
from tests.kit.ros import reserved

PAGE = Path(__file__).parents[2] / "docs" / "tutorial.md"


def test_counted_cars_become_a_warning(tmp_path: Path) -> None:
    scripts = {}
    for block in pages.blocks(PAGE.read_text()):
        if block.language == "python":
            script = tmp_path / Path(block.title).name
            script.write_text(block.text)
            scripts[script.stem] = str(script)
    arguments = {
        "density": ["/mast01/cars", "/mast01_density"],
        "warning": ["/ring_road_warning", "/mast01_density", "/mast02_density"],
    }
    assert scripts.keys() == arguments.keys()
    with reserved() as domain:
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
        services = [
            subprocess.Popen([sys.executable, scripts[name], *topics], env=environment)
            for name, topics in arguments.items()
        ]
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        try:
            node = rclpy.create_node("bus01", context=context)
            heard: list[str] = []
            node.create_subscription(
                String, "/ring_road_warning", lambda message: heard.append(message.data), 10
            )
            cars = node.create_publisher(Int32, "/mast01/cars", 10)
            executor = rclpy.executors.SingleThreadedExecutor(context=context)
            end = time.monotonic() + PATIENCE_S
            while not heard and time.monotonic() < end:
                cars.publish(Int32(data=30))
                rclpy.spin_once(node, executor=executor, timeout_sec=0.1)
            assert heard[:1] == ["queue ahead: /mast01_density is 30"]
        finally:
            for service in services:
                service.kill()
            for service in services:
                service.wait()
            rclpy.shutdown(context=context)
