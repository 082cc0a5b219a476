"""What both ends of an action must agree on: deep queues, and one server for each name."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node
from rclpy.qos import QoSProfile

DEEP_QOS = QoSProfile(depth=2000)
"""The queues for goals, results, cancels and feedback. ROS's default of 10 loses some of a burst. A
client's queue also gets the answers to other clients, which the client drops."""


class OtherServers:
    """Finds other nodes that serve the same actions, and logs when they come and go."""

    def __init__(self, node: Node, actions: Iterable[str]) -> None:
        self._node = node
        self._own = f"{node.get_namespace().rstrip('/')}/{node.get_name()}"
        self._found = {node.resolve_service_name(action): list[str]() for action in actions}

    def find(self) -> dict[str, list[str]]:
        """Return the other nodes that serve each action, as far as they are discovered."""
        for action, others in self._found.items():
            now = self._others(action)
            if now and now != others:
                self._node.get_logger().warning(
                    f"{', '.join(now)} serves {action} too: a client may get an answer of either; "
                    "give each node an action name of its own"
                )
            elif others and not now:
                self._node.get_logger().info(f"no other node serves {action} any more")
            self._found[action] = now
        return self._found

    def _others(self, action: str) -> list[str]:
        """Return the nodes that publish an action's status, without this one."""
        publishers = self._node.get_publishers_info_by_topic(f"{action}/_action/status")
        names = [f"{one.node_namespace.rstrip('/')}/{one.node_name}" for one in publishers]
        if self._own in names:
            names.remove(self._own)  # once: another may have the same name
        return sorted(names)
