"""A ROS 2 action client for DeploymentRequest goals from YAML files.

The client reads the path of one file from each line of standard input. It prints one line of JSON
for each feedback and one for the result. It works with any server of the action.
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


def _print_json(**facts: object) -> None:
    print(json.dumps(facts), flush=True)


def main() -> int:
    """Send one goal for each line of standard input."""
    rclpy.init()
    node = rclpy.create_node("experiment_client")
    client = ActionClient(node, DeploymentRequest, sys.argv[1])
    if not client.wait_for_server(timeout_sec=_WAIT_S):
        _print_json(status="no server", message=f"no server of {sys.argv[1]}")
        return 1
    _print_json(status="ready")
    for line in sys.stdin:
        goal = fill_message(
            DeploymentRequest.Goal(), yaml.safe_load(Path(line.strip()).read_text())
        )
        acceptance = client.send_goal_async(
            goal,
            feedback_callback=lambda message: _print_json(feedback=message.feedback.message),
        )
        rclpy.spin_until_future_complete(node, acceptance)
        if not acceptance.result().accepted:
            _print_json(status="rejected", message="the server accepts no goals now")
            continue
        result = acceptance.result().get_result_async()
        rclpy.spin_until_future_complete(node, result)
        answer = result.result()
        _print_json(status=_STATUS.get(answer.status, "aborted"), message=answer.result.message)
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
