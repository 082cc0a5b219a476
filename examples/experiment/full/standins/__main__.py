"""Stands in for `ros2 launch PACKAGE FILE NAME:=VALUE…` in the containers of the experiment."""

from __future__ import annotations

import os
import sys
from importlib import import_module

PROGRAMS = {
    ("point_cloud_object_detection", "point_cloud_object_detection.launch.py"): "detection",
    ("object_fusion", "fusion_function_launch.py"): "fusion",
    ("mqtt_client", "standalone.launch.ros2.xml"): "mqtt_client",
}
"""For each launch file of the reference's images, the module that stands in for it."""
OURS = ("demandops_ros", "parameter_sync.launch.xml")


def main(launch: str, package: str, file: str, *arguments: str) -> None:
    """Run the program of our own launch file, or the stand-in for one of the reference."""
    assert launch == "launch", launch
    given = dict(argument.split(":=", 1) for argument in arguments)
    if (package, file) == OURS:
        # what the launch file runs; ROS's `launch` itself does not come as a Python wheel
        ros_args = ["-r", f"__node:={given['node_name']}", "--params-file", given["params"]]
        command = [sys.executable, "-m", "demandops.cli.main", "parameter-sync", "--ros-args"]
        os.execv(sys.executable, [*command, *ros_args])  # noqa: S606 - no shell on purpose
    import_module(f".{PROGRAMS[package, file]}", __package__).main(given)


if __name__ == "__main__":
    main(*sys.argv[1:])
