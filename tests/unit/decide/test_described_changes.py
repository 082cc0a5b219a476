"""What a commit says of a release that changes: what its file has from the change, and once."""

from __future__ import annotations

from typing import Any

from tests.kit.config import brokers, edited
from tests.kit.memory import MemoryRepo

_APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
_USED = "parameters: {used: {default: 1}, unused: {default: 1}}\ninputs:\n"
_TEMPLATE = "appdefs/object-detection-fusion/values/object-fusion.yaml.j2"
_TOPIC = {"topic_name": "/a", "source_node_id": "vehicle00"}


def _put(used: int, unused: int, topic: str) -> dict[str, Any]:
    inputs = {"ego_data": [{"topic": topic, "source": "vehicle00"}]}
    app = {"id": "a", "type": "object-detection-fusion", "node": "edge", "inputs": inputs}
    app |= {"parameters": {"used": used, "unused": unused}, "connect": "none"}
    return {"kind": "Demand", "demand": "d", "requesters": ["u"], "applications": [app]}


def test_a_parameter_that_the_values_do_not_use_is_no_part_of_a_change() -> None:
    name = "nodeName: {{ (release | ros_name)"
    uses = edited(_TEMPLATE, name, f"{name} ~ parameters.used")
    repo = MemoryRepo(edited(_APPDEF, "inputs:\n", _USED) | uses)
    repo.send(_put(1, 1, "/a"))
    assert repo.send(_put(1, 2, "/a")).releases == ()
    (change,) = repo.send(_put(2, 3, "/b")).releases
    assert change.details == ("- ego_data /a", "- used = 1", "+ ego_data /b", "+ used = 2")


def test_what_is_listed_twice_is_warned_of_once() -> None:
    app = {"header": {"id": "a", "node_id": "edge"}, "type": 1}
    app |= {"object_detection_fusion_app": {"requester_ids": ["u"], "ego_data_topics": [_TOPIC]}}
    without_brokers = MemoryRepo(brokers())  # so that no connection can be derived
    (warning,) = without_brokers.send({"id": "r", "apps": [app, app]}).warnings
    assert "no connection carries /a" in warning
