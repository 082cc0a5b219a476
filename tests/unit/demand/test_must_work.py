"""Demands that leave out much, or whose requesters have similar names, are booked."""

from __future__ import annotations

from itertools import combinations

import pytest
import yaml

from tests.kit.config import brokers, skeleton
from tests.kit.connections import IMAGES, ROS_IMAGE, WAN
from tests.kit.goals import application, connection, goal, perception, put
from tests.kit.memory import MemoryRepo


class TestOpenBroker:
    """If only one broker exists, every connection gets this broker.

    If several brokers exist, a connection gets the requested broker. If there is no such broker,
    it gets the target's broker, or else the source's broker.
    """

    @staticmethod
    def hosts(books: MemoryRepo) -> set[str]:
        return {
            yaml.safe_load(config["data"]["params.yaml"])["/**/*"]["ros__parameters"]["broker"][
                "host"
            ]
            for config in books.objects("ConfigMap").values()
        }

    @pytest.mark.parametrize(
        ("there", "requested", "ends", "chosen"),
        [
            (("cloud", "edge", "vehicle00"), "cloud", ("vehicle00", "edge"), "cloud"),
            (("edge",), "edge", ("vehicle00", "cloud"), "edge"),
            (("cloud", "edge", "vehicle00"), "", ("vehicle00", "edge"), "edge"),
            (("cloud", "vehicle00"), "", ("vehicle00", "edge"), "vehicle00"),
            (("cloud",), "", ("vehicle00", "edge"), "cloud"),
            (("cloud",), "edge", ("vehicle00", "edge"), "cloud"),
            (("cloud", "edge"), "nowhere", ("vehicle00", "edge"), "edge"),
            (("cloud", "vehicle00"), "station00", ("vehicle00", "edge"), "vehicle00"),
        ],
        ids=["the requested", "the requested, which is the only one", "the target's",
             "the source's", "the only one", "the only one instead of the requested",
             "the target's instead of one that is not there",
             "the source's instead of one that is not there"],
    )  # fmt: skip
    def test_the_broker_is_chosen_by_rule(
        self, there: tuple[str, ...], requested: str, ends: tuple[str, str], chosen: str
    ) -> None:
        books = MemoryRepo(brokers(*there))
        books.send(goal([], [connection(broker=requested, ends=ends)]))
        assert self.hosts(books) == {f"broker-{chosen}"}

    @pytest.mark.parametrize(
        ("there", "requested", "note"),
        [
            (("cloud",), "edge", "'cloud', because inventory/brokers.yaml has none on 'edge'"),
            (
                ("cloud", "edge"),
                "nowhere",
                "'edge', because inventory/brokers.yaml has none on 'nowhere'",
            ),
        ],
    )
    def test_the_receipt_says_if_it_is_not_the_requested_one(
        self, there: tuple[str, ...], requested: str, note: str
    ) -> None:
        books = MemoryRepo(brokers(*there))
        decision = books.send(goal([], [connection(broker=requested)]))
        assert decision.warnings == (f"connection 'vehicle00/edge' uses the broker on {note}",)
        again = books.send(goal([], [connection(broker=there[-1])], id="2"))
        assert again.outcome == "booked", "both goals must get the same broker"

    def test_a_broker_left_open_and_one_named_for_one_connection_agree(self) -> None:
        books = MemoryRepo()
        books.send(goal([], [connection(broker="")], id="1"))
        assert books.send(goal([], [connection(broker="cloud")], id="2")).outcome == "booked"
        assert self.hosts(books) == {"service-mqtt-broker-cloud.default.svc"}
        books.send(goal([], [connection(broker="cloud")], id="2", shutdown=True))
        assert self.hosts(books) == {"service-mqtt-broker-edge.default.svc"}


def test_absent_fields_take_the_defaults_of_ros() -> None:
    books = MemoryRepo()
    books.send(perception())
    asked = {
        "id": "request",
        "shutdown": True,
        "apps": [
            {
                "header": {"id": "edge/object_detection_fusion"},
                "type": 1,
                "object_detection_fusion_app": {"requester_ids": ["vehicle00"]},
            }
        ],
        "connections": [{"id": "vehicle00/edge", "type": 1, "requester_ids": ["vehicle00"]}],
    }
    assert books.send(asked).outcome == "released"
    assert books.rendered() == {}


def test_every_pair_of_odd_requesters_makes_its_own_demand() -> None:
    texts = ["a", "a,b", "b", "a b", '["a"]', "a\\", "\\a", '"']
    books = MemoryRepo()
    for pair in combinations(texts, 2):
        books.send(goal([application(who=pair)]))
    demands = {claim.demand for claim in books.state.ledger}
    assert len(demands) == len(list(combinations(texts, 2)))


def test_a_derived_ros_connection_has_the_message_type_of_the_input() -> None:
    inventory = yaml.safe_load(skeleton()["inventory/nodes.yaml"])
    for node in inventory["nodes"]:
        node.update(WAN if node["id"] == "edge" else {})
    files = {"inventory/nodes.yaml": yaml.safe_dump(inventory)}
    books = MemoryRepo(files | {IMAGES: skeleton()[IMAGES] + ROS_IMAGE})
    app = {"id": "edge/typed", "type": "object-detection-fusion", "node": "edge", "connect": "ros"}
    topic = {"topic": "/points", "source": "vehicle00", "type": "sensor_msgs/msg/PointCloud2"}
    app["inputs"] = {"point_cloud": [topic]}  # type: ignore[assignment]
    for outcome in ("booked", "unchanged"):
        sent = books.send(put("typed", "me", applications=[app], connections=[]))
        assert sent.outcome == outcome
    (claim,) = (one for one in books.state.ledger if not one.is_on_application)
    assert [route.type for route in claim.connection.topics] == [topic["type"]]
