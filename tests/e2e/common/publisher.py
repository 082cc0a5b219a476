"""A stand-in for `ros2 launch` in a pod of detection or fusion; it publishes on each output."""

from __future__ import annotations

import sys

import rclpy
from rclpy.node import Node
from std_msgs.msg import String

OUTPUTS = ("object_list_topic", "fused_object_lists_topic", "fused_trajectories_topic")
"""The launch arguments that name outputs, in the launch files of the reference's images."""


def main(launch: str, package: str, file: str, *arguments: str) -> None:
    """Publish the ROS node's name on each given output until this process is killed."""
    given = dict(argument.split(":=", 1) for argument in arguments)
    rclpy.init(args=[])
    node = Node(given["node_name"])
    senders = [node.create_publisher(String, given[name], 10) for name in OUTPUTS if name in given]
    node.create_timer(
        0.1, lambda: [sender.publish(String(data=node.get_name())) for sender in senders]
    )
    rclpy.spin(node)


if __name__ == "__main__":
    main(*sys.argv[1:])
