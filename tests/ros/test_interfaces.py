"""The ROS 2 interfaces: their wire format, and the values that they cannot carry."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from application_manager_interfaces.action import DeploymentRequest
from application_manager_interfaces.msg import Application, Connection
from demandops.base.errors import Refused
from demandops.model.demand.goals import read_goal
from demandops_interfaces.action import Demand
from demandops_ros.messages import demand_goal_from_data, demand_goal_to_data, fill_message

from tests.kit import forms, plain_yaml

REFUSED = plain_yaml.load(Path(__file__).with_name("refused.yaml").read_text())
OURS = "application_manager_interfaces"

# The hash of the reference's action with all its messages and their fields; a client of the
# reference finds only a server with this hash.
TYPE_HASH = "RIHS01_1190e6ea1469f559e7fc3c50e3255e75c519f1e3ed29a5f860b0ad8f41786bd9"


def test_the_action_has_the_type_hash_of_the_reference() -> None:
    file = Path(sys.prefix) / "share" / OURS / "action" / "DeploymentRequest.json"
    hashes = json.loads(file.read_text(encoding="utf-8"))["type_hashes"]
    by_name = {entry["type_name"]: entry["hash_string"] for entry in hashes}
    assert by_name[f"{OURS}/action/DeploymentRequest"] == TYPE_HASH


def test_constants_and_defaults_which_have_no_hash_are_those_of_the_contract() -> None:
    assert Application.TYPE_OBJECT_DETECTION_FUSION == 1
    assert (Connection.TYPE_ROS, Connection.TYPE_MQTT, Connection.TYPE_ZENOH) == (0, 1, 2)
    assert (Application().type, Connection().type, Connection().broker_node_id) == (0, 0, "")
    goal = DeploymentRequest.Goal()
    assert (goal.id, goal.apps, goal.connections, goal.shutdown) == ("", [], [], False)


def test_a_message_carries_every_field_of_a_demand() -> None:
    goal = forms.own_goal()
    carried = read_goal(demand_goal_to_data(demand_goal_from_data(goal)))
    assert carried.demanded == read_goal(goal).demanded


def test_numbers_that_the_message_does_not_define_are_faults_of_their_fields() -> None:
    goal = Demand.Goal(operation=7, demand_id="d", requester_ids=["r"], answer=9)
    with pytest.raises(Refused) as refused:
        read_goal(demand_goal_to_data(goal))
    assert {"operation", "answer"} <= {fault.field for fault in refused.value.faults}


def test_a_value_that_a_message_cannot_carry_is_refused_before_it_is_sent() -> None:
    """Without the refusal, the value ends the process that sends it."""
    for wrong in REFUSED["demands"]:
        with pytest.raises(AssertionError, match="field must be"):
            demand_goal_from_data(wrong)
    for wrong in ({"id": 5}, {"apps": [{"header": {"id": 5}}]}):
        with pytest.raises(AssertionError, match="field must be"):
            fill_message(DeploymentRequest.Goal(), wrong)
