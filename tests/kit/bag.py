"""Write ROS bags of vehicles' poses, as MCAP or sqlite3, without an installed ROS."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tests.kit.detection import POSE

_STRING = "std_msgs/msg/String"
_TYPES = get_typestore(Stores.ROS2_KILTED)


def write_bag(
    path: Path,
    poses: Iterable[tuple[float, str, float, float]],
    plugin: StoragePlugin = StoragePlugin.MCAP,
    texts: Iterable[tuple[float, str, str]] = (),
) -> None:
    """Write a new bag of poses in the order of time, after the texts; times are in seconds."""
    new = _TYPES.types
    topics: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        for at, topic, text in texts:
            other = writer.add_connection(topic, _STRING, typestore=_TYPES)
            data = _TYPES.serialize_cdr(new[_STRING](text), _STRING)
            writer.write(other, round(at * 1e9), data)
        for at, vehicle, x, y in poses:
            nanoseconds = round(at * 1e9)
            if vehicle not in topics:
                topic = f"/vehicles/{vehicle}/pose"
                topics[vehicle] = writer.add_connection(topic, POSE, typestore=_TYPES)
            stamp = new["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
            head = new["std_msgs/msg/Header"](stamp, "map")
            turned = new["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            place = new["geometry_msgs/msg/Point"](x, y, 0.0)
            pose = new[POSE](head, new["geometry_msgs/msg/Pose"](place, turned))
            writer.write(topics[vehicle], nanoseconds, _TYPES.serialize_cdr(pose, POSE))
