"""What a receipt says, it says once."""

from __future__ import annotations

from tests.kit.config import brokers
from tests.kit.memory import MemoryRepo

_TOPIC = {"topic_name": "/a", "source_node_id": "vehicle00"}


def test_what_is_listed_twice_is_warned_of_once() -> None:
    app = {"header": {"id": "a", "node_id": "edge"}, "type": 1}
    app |= {"object_detection_fusion_app": {"requester_ids": ["u"], "ego_data_topics": [_TOPIC]}}
    without_brokers = MemoryRepo(brokers())  # so that no connection can be derived
    (warning,) = without_brokers.send({"id": "r", "apps": [app, app]}).warnings
    assert "no connection carries /a" in warning
