"""A ROS 2 action client that records the time of each stage.

It spins in its own thread, so each stage gets the time of its feedback while a test waits for
the cluster.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from application_manager_interfaces.action import DeploymentRequest
from demandops.settings import DEFAULT_ACTION_NAME
from demandops_ros.messages import fill_message
from demandops_ros.node import DEEP_QOS
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor

Goal = dict[str, Any]

_STATUS = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_ABORTED: "aborted",
    GoalStatus.STATUS_CANCELED: "cancelled",
}
_ANSWER_S = 60.0


@dataclass
class Sent:
    """A sent goal: the time of each stage so far, and finally the result."""

    at: float
    stages: dict[str, float] = field(default_factory=dict)
    status: str = ""
    message: str = ""
    accepted: threading.Event = field(default_factory=threading.Event)
    answered: threading.Event = field(default_factory=threading.Event)

    @property
    def commit(self) -> str:
        """Return the commit that the result names."""
        return self.message.splitlines()[0].split()[-1]

    def wait_stage(self, stage: str, timeout: float = 60.0) -> None:
        """Wait for the feedback of a stage."""
        deadline = time.monotonic() + timeout
        while stage not in self.stages:
            assert time.monotonic() < deadline, f"no feedback '{stage}', only {list(self.stages)}"
            time.sleep(0.005)


class Client:
    """Sends goals to the node of one ROS domain."""

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("e2e_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        deep = {
            f"{service}_service_qos_profile": DEEP_QOS for service in ("goal", "result", "cancel")
        }
        self._client = ActionClient(self._node, DeploymentRequest, DEFAULT_ACTION_NAME, **deep)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def reaches_a_node(self) -> bool:
        """Return whether the client sees an action server."""
        return bool(self._client.server_is_ready())

    def send(self, goal: Goal) -> Sent:
        """Send a goal and return at once."""
        sent = Sent(time.monotonic())
        future = self._client.send_goal_async(
            fill_message(DeploymentRequest.Goal(), goal),
            feedback_callback=lambda answer: _note_stage(sent, answer.feedback.message),
        )
        future.add_done_callback(lambda done: self._on_response(sent, done.result()))
        return sent

    def call(self, goal: Goal) -> Sent:
        """Send a goal and wait for its result; send it again if no node accepts it.

        The client still sees a killed server for a while, and goals to it are lost.
        """
        deadline = time.monotonic() + _ANSWER_S
        sent = self.send(goal)
        while not sent.accepted.wait(3):
            assert time.monotonic() < deadline, "no node accepts the goal"
            sent = self.send(goal)
        assert sent.answered.wait(_ANSWER_S), f"no result; feedback {list(sent.stages)}"
        return sent

    def close(self) -> None:
        """Leave the ROS graph."""
        self._executor.shutdown(timeout_sec=1)
        self._thread.join(5)
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    @staticmethod
    def _on_response(sent: Sent, handle: Any) -> None:
        assert handle.accepted
        sent.accepted.set()
        handle.get_result_async().add_done_callback(lambda done: _finish(sent, done.result()))


def _note_stage(sent: Sent, message: str) -> None:
    sent.stages[message.split(maxsplit=1)[0]] = time.monotonic()


def _finish(sent: Sent, answer: Any) -> None:
    sent.stages.setdefault("pushed", time.monotonic())
    sent.message, sent.status = answer.result.message, _STATUS[answer.status]
    sent.answered.set()
