"""A ROS 2 action client: sends each request file that it is told of on standard input.

One line in, the path of a YAML file with a DeploymentRequest goal; JSON lines out: one for each
feedback and one for the result. Nothing in it knows the server.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import rclpy
import yaml
from action_msgs.msg import GoalStatus
from application_manager_interfaces.action import DeploymentRequest
from demandops_ros.messages import fill_message
from rclpy.action import ActionClient

_WAIT_S = 20.0
_STATUS = {GoalStatus.STATUS_SUCCEEDED: "succeeded", GoalStatus.STATUS_CANCELED: "cancelled"}


def _say(**facts: object) -> None:
    print(json.dumps(facts), flush=True)


def main() -> int:
    """Send one goal for each line of standard input."""
    rclpy.init()
    node = rclpy.create_node("experiment_client")
    client = ActionClient(node, DeploymentRequest, sys.argv[1])
    if not client.wait_for_server(timeout_sec=_WAIT_S):
        _say(status="no server", message=f"nobody serves {sys.argv[1]}")
        return 1
    _say(status="ready")
    for line in sys.stdin:
        goal = fill_message(
            DeploymentRequest.Goal(), yaml.safe_load(Path(line.strip()).read_text())
        )
        sent = client.send_goal_async(
            goal, feedback_callback=lambda told: _say(feedback=told.feedback.message)
        )
        rclpy.spin_until_future_complete(node, sent)
        if not sent.result().accepted:
            _say(status="rejected", message="the server takes no goal now")
            continue
        done = sent.result().get_result_async()
        rclpy.spin_until_future_complete(node, done)
        answer = done.result()
        _say(status=_STATUS.get(answer.status, "aborted"), message=answer.result.message)
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
