"""Print as JSON the parameters that the real rcl gives a ROS node from its arguments."""

from __future__ import annotations

import json
import sys

import rclpy
from rclpy.node import Node


def main() -> None:
    """Start a node with the process's arguments; print its name and its parameters."""
    rclpy.init(args=sys.argv)
    node = Node("replaced_by_remapping", automatically_declare_parameters_from_overrides=True)
    known = {name: found.value for name, found in node.get_parameters_by_prefix("").items()}
    print(json.dumps({"node": node.get_name(), "parameters": known}))
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
