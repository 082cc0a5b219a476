"""The ROS 2 interfaces: their wire format, and a goal with its feedback and result.

A test runs this file as a script, which calls `round_trip`, in an environment of its own.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

OURS = "application_manager_interfaces"

# The hash of the reference's action; a client of the reference finds only a server with this hash.
TYPE_HASH = "RIHS01_1190e6ea1469f559e7fc3c50e3255e75c519f1e3ed29a5f860b0ad8f41786bd9"

# The wire format


def described(path: str) -> dict[str, str]:
    """Return the type hashes in a generated type description, by type name."""
    file = Path(sys.prefix) / "share" / path
    hashes = json.loads(file.read_text(encoding="utf-8"))["type_hashes"]
    return {entry["type_name"]: entry["hash_string"] for entry in hashes}


def test_the_action_has_the_type_hash_of_the_reference() -> None:
    hashes = described(f"{OURS}/action/DeploymentRequest.json")
    assert hashes[f"{OURS}/action/DeploymentRequest"] == TYPE_HASH


FIELDS: dict[str, dict[str, tuple[str, object]]] = {
    "Application": {
        "header": (f"{OURS}/ApplicationHeader", None),
        "type": ("uint8", 0),
        "object_detection_fusion_app": (f"{OURS}/ObjectDetectionFusionApp", None),
    },
    "ApplicationHeader": {"id": ("string", ""), "node_id": ("string", "")},
    "ObjectDetectionFusionApp": {
        "requester_ids": ("sequence<string>", []),
        "ego_data_topics": (f"sequence<{OURS}/Topic>", []),
        "pointcloud_topics": (f"sequence<{OURS}/Topic>", []),
    },
    "Connection": {
        "id": ("string", ""),
        "broker_node_id": ("string", ""),
        "requester_ids": ("sequence<string>", []),
        "source_node_id": ("string", ""),
        "source_topics": ("sequence<string>", []),
        "target_node_id": ("string", ""),
        "target_topics": ("sequence<string>", []),
        "type": ("uint8", 0),
    },
    "Topic": {
        "topic_name": ("string", ""),
        "source_node_id": ("string", ""),
        "type": ("string", ""),
    },
}


def check_fields(message: Any, expected: dict[str, tuple[str, object]]) -> None:
    types = {name: field_type for name, (field_type, _) in expected.items()}
    assert list(message.get_fields_and_field_types().items()) == list(types.items())
    made = message()
    for name, (_, default) in expected.items():
        if default is not None:
            assert getattr(made, name) == default, name


@pytest.mark.parametrize("name", FIELDS)
def test_a_message_has_the_fields_of_the_contract(name: str) -> None:
    messages = importlib.import_module(f"{OURS}.msg")
    check_fields(getattr(messages, name), FIELDS[name])


def test_the_action_has_the_fields_of_the_contract() -> None:
    from application_manager_interfaces.action import DeploymentRequest

    check_fields(
        DeploymentRequest.Goal,
        {
            "apps": (f"sequence<{OURS}/Application>", []),
            "connections": (f"sequence<{OURS}/Connection>", []),
            "id": ("string", ""),
            "shutdown": ("boolean", False),
        },
    )
    check_fields(DeploymentRequest.Result, {"message": ("string", "")})
    check_fields(DeploymentRequest.Feedback, {"message": ("string", "")})


def test_the_constants_have_the_values_of_the_contract() -> None:
    from application_manager_interfaces.msg import Application, Connection

    assert Application.TYPE_OBJECT_DETECTION_FUSION == 1
    assert (Connection.TYPE_ROS, Connection.TYPE_MQTT, Connection.TYPE_ZENOH) == (0, 1, 2)


def test_the_bookkeeping_is_a_service() -> None:
    from demandops_interfaces.srv import GetBookkeeping

    check_fields(GetBookkeeping.Request, {"at": ("string", "")})
    check_fields(
        GetBookkeeping.Response,
        {
            "ok": ("boolean", False),
            "message": ("string", ""),
            "commit": ("string", ""),
            "bookkeeping_json": ("string", ""),
        },
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"demand": 5},
        {"priority": 2**31},
        {"lease": 2**31},
        {"requesters": [1]},
        {"applications": [{"id": 3}]},
        {"applications": [{"inputs": {"points": [{"topic": 1}]}}]},
        {"connections": [{"topics": [{"qos": -1}]}]},
        {"positions": [{"x": "far"}]},
    ],
)
def test_a_value_that_a_demand_cannot_carry_is_refused_before_it_is_sent(
    wrong: dict[str, Any],
) -> None:
    """Without the refusal, the value ends the process that sends it."""
    from demandops_ros.messages import demand_goal_from_data

    with pytest.raises(AssertionError, match="field must be"):
        demand_goal_from_data(wrong)


@pytest.mark.parametrize("wrong", [{"id": 5}, {"apps": [{"header": {"id": 5}}]}])
def test_a_value_that_a_deployment_request_cannot_carry_is_refused(wrong: dict[str, Any]) -> None:
    from application_manager_interfaces.action import DeploymentRequest
    from demandops_ros.messages import fill_message

    with pytest.raises(AssertionError, match="field must be"):
        fill_message(DeploymentRequest.Goal(), wrong)


# The round trip


def test_a_goal_goes_round_with_nothing_set_by_hand(tmp_path: Path, ros_domain: int) -> None:
    from tests.kit.limits import PATIENCE_S  # not found where this file runs as a program

    alone = {
        "HOME": str(tmp_path),
        "ROS_DOMAIN_ID": str(ros_domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    result = subprocess.run(
        [sys.executable, __file__],
        env=alone,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == {
        "feedback": ["booked"],
        "result": "corridor: edge/object_detection_fusion on edge-west, "
        "/vehicle00/points as /vehicle00/points over 1",
        "status": 4,
    }


def round_trip() -> None:
    """Send a goal to a server in this process; print its status, feedback and result as JSON."""
    import rclpy
    from application_manager_interfaces.action import DeploymentRequest
    from application_manager_interfaces.msg import Application, Connection
    from rclpy.action import ActionClient, ActionServer

    def execute(handle: Any) -> Any:
        (app,), (connection,) = handle.request.apps, handle.request.connections
        handle.publish_feedback(DeploymentRequest.Feedback(message="booked"))
        handle.succeed()
        return DeploymentRequest.Result(
            message=f"{handle.request.id}: {app.header.id} on {app.header.node_id}, "
            f"{connection.source_topics[0]} as {connection.target_topics[0]} "
            f"over {connection.type}"
        )

    rclpy.init()
    node = rclpy.create_node("round_trip")
    server = ActionServer(node, DeploymentRequest, "demand", execute)
    client = ActionClient(node, DeploymentRequest, "demand")
    if not client.wait_for_server(timeout_sec=240):
        sys.exit("no server was discovered")

    goal = DeploymentRequest.Goal(id="corridor")
    goal.apps = [Application(type=Application.TYPE_OBJECT_DETECTION_FUSION)]
    goal.apps[0].header.id = "edge/object_detection_fusion"
    goal.apps[0].header.node_id = "edge-west"
    points = ["/vehicle00/points"]
    goal.connections = [
        Connection(source_topics=points, target_topics=points, type=Connection.TYPE_MQTT)
    ]
    feedback: list[str] = []
    sent = client.send_goal_async(
        goal, feedback_callback=lambda got: feedback.append(got.feedback.message)
    )
    rclpy.spin_until_future_complete(node, sent, timeout_sec=240)
    done = sent.result().get_result_async()
    rclpy.spin_until_future_complete(node, done, timeout_sec=240)
    answer = done.result()
    print(
        json.dumps({"feedback": feedback, "result": answer.result.message, "status": answer.status})
    )
    client.destroy()
    server.destroy()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    round_trip()
