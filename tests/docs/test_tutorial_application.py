"""The services of the tutorial's application do what the tutorial says."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

from std_msgs.msg import Int32, String

from tests.kit.ros import Client, reserved

EXAMPLE = Path(__file__).parents[2] / "examples" / "queue-warning" / "fleet"
SCRIPTS = EXAMPLE / "appdefs" / "queue-warning" / "charts" / "ros-script" / "scripts"
ARGUMENTS = {
    "density": ["/mast01/cars", "/mast01_density"],
    "warning": ["/ring_road_warning", "/mast01_density", "/mast02_density"],
}


def test_counted_cars_become_a_warning() -> None:
    assert {script.stem for script in SCRIPTS.iterdir()} == ARGUMENTS.keys()
    with reserved() as domain, ExitStack() as stack:
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
        for name, topics in ARGUMENTS.items():
            command = [sys.executable, SCRIPTS / f"{name}.py", *topics]
            service = stack.enter_context(subprocess.Popen(command, env=environment))
            stack.callback(service.kill)
        bus = Client(domain)
        stack.callback(bus.close)
        heard: list[str] = []
        bus.node.create_subscription(
            String, "/ring_road_warning", lambda message: heard.append(message.data), 10
        )
        cars = bus.node.create_publisher(Int32, "/mast01/cars", 10)
        bus.wait(lambda: cars.publish(Int32(data=30)) or bool(heard))
    assert heard[0] == "queue ahead: /mast01_density is 30"
