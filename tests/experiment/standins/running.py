"""Helpers of all stand-ins: find a message type by its name, and spin a ROS node until SIGTERM."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node


def message_class(type_name: str) -> Any:
    """Return the class of a message type, such as `geometry_msgs/msg/PoseStamped`."""
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def spin(node: Node) -> None:
    """Spin until the program is asked to end."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (ExternalShutdownException, KeyboardInterrupt):
        pass
    finally:
        rclpy.try_shutdown()
