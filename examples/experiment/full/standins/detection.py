"""A stand-in for the detection: a point cloud becomes a list of objects."""

from __future__ import annotations

from collections.abc import Iterable

from geometry_msgs.msg import Pose, PoseArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from examples.experiment.full.clouds import Point, from_message

from .running import spin, start

_REACH_M = 3.0
_FEWEST_POINTS = 5


def cluster(points: Iterable[Point]) -> list[tuple[float, float]]:
    """Return the centres of groups of nearby points, except groups with few points."""
    groups: list[tuple[float, float, int]] = []  # sums of x and y, and how many
    for x, y, _ in points:
        for index, (sum_x, sum_y, count) in enumerate(groups):
            if abs(sum_x / count - x) < _REACH_M and abs(sum_y / count - y) < _REACH_M:
                groups[index] = (sum_x + x, sum_y + y, count + 1)
                break
        else:
            groups.append((x, y, 1))
    return [(x / count, y / count) for x, y, count in groups if count >= _FEWEST_POINTS]


def pose_at(x: float, y: float) -> Pose:
    """Return the pose of an object whose heading is unknown."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.orientation.w = x, y, 1.0
    return pose


def main(given: dict[str, str]) -> None:
    start()
    node = Node(given["node_name"])
    sender = node.create_publisher(PoseArray, given["object_list_topic"], 10)

    def detect(cloud: PointCloud2) -> None:
        objects = [pose_at(x, y) for x, y in cluster(from_message(cloud))]
        sender.publish(PoseArray(header=cloud.header, poses=objects))

    node.create_subscription(PointCloud2, given["point_cloud_topic"], detect, 10)
    spin(node)
