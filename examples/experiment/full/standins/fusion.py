"""A stand-in for the fusion: object lists and ego data become one list.

Its inputs can change while it runs.
"""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseArray, PoseStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter

from .detection import pose_at
from .running import spin, start

_PERIOD_S = 0.2
_SAME_M = 3.0
_INPUTS = {
    "additional_inputs.topics_egodata": PoseStamped,
    "additional_inputs.topics_objectlist": PoseArray,
}


class Fusion(Node):
    """Fuses the newest message of each input, and publishes all objects and the vehicles' tracks.

    It takes times from the messages and a steady clock, not from ROS, because the chart sets
    `use_sim_time` by default, and no simulated clock runs here.
    """

    def __init__(self, given: dict[str, str]) -> None:
        super().__init__(given["node_name"])
        self._newest: dict[str, Any] = {}
        self._inputs: dict[str, Any] = {}
        self._objects = self.create_publisher(PoseArray, given["fused_object_lists_topic"], 10)
        self._tracks = self.create_publisher(PoseArray, given["fused_trajectories_topic"], 10)
        self._subscribe(given["raw_object_lists_topic"], PoseArray)
        self.declare_parameter("additional_inputs.mode", "dynamic")
        self.declare_parameter("additional_inputs.length", 0)
        for name in _INPUTS:
            self.declare_parameter(name, [""])
        self.add_on_set_parameters_callback(self._follow)
        self.create_timer(_PERIOD_S, self._fuse, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _follow(self, changes: list[Parameter]) -> SetParametersResult:
        for change in changes:
            if change.name not in _INPUTS:
                continue
            kind = _INPUTS[change.name]
            wanted = {topic for topic in change.value if topic}
            known = {topic for topic, entry in self._inputs.items() if entry.msg_type is kind}
            for topic in known - wanted:
                self.destroy_subscription(self._inputs.pop(topic))
                self._newest.pop(topic, None)
            for topic in wanted - known:
                self._inputs[topic] = self._subscribe(topic, kind)
        return SetParametersResult(successful=True)

    def _subscribe(self, topic: str, kind: Any) -> Any:
        return self.create_subscription(
            kind, topic, lambda message: self._newest.__setitem__(topic, message), 10
        )

    def _fuse(self) -> None:
        if not self._newest:
            return
        messages = list(self._newest.values())
        newest = max(messages, key=lambda m: (m.header.stamp.sec, m.header.stamp.nanosec))
        egos = [message.pose for message in messages if isinstance(message, PoseStamped)]
        seen = list(egos)
        for message in messages:
            if isinstance(message, PoseArray):
                seen += [pose for pose in message.poses if not _is_among(pose, seen)]
        places = [pose_at(pose.position.x, pose.position.y) for pose in seen]
        self._objects.publish(PoseArray(header=newest.header, poses=places))
        self._tracks.publish(PoseArray(header=newest.header, poses=egos))


def _is_among(pose: Any, others: list[Any]) -> bool:
    return any(
        abs(pose.position.x - other.position.x) < _SAME_M
        and abs(pose.position.y - other.position.y) < _SAME_M
        for other in others
    )


def main(given: dict[str, str]) -> None:
    start()
    spin(Fusion(given))
