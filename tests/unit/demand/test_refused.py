"""What a demand must not say; ``tests/unit/messages`` holds what is said of ``REFUSED``."""

from __future__ import annotations

from typing import Any

import pytest

from tests.kit.config import brokers
from tests.kit.goals import (
    APP,
    BODY,
    CLOUD,
    EGO,
    ROS_NAMES,
    Goal,
    application,
    connection,
    goal,
    perception,
)
from tests.kit.memory import MemoryRepo

NODES = "cloud, edge, station00, vehicle00, vehicle01, vehicle02, vehicle03"
TYPES = "known: 0 (ROS), 1 (MQTT), 2 (ZENOH)"
C0 = "connections[0]"


REFUSED: dict[str, Goal] = {
    "an application type that no definition has": goal([application(type=9)]),
    "an application without a type": goal(
        [{key: value for key, value in application().items() if key != "type"}]
    ),
    "a connection type that does not exist": goal([], [connection(type=3)]),
    "a ROS connection, for which the inventory has nothing": goal(
        [], [connection(type=0, broker="", topics=["/a"])]
    ),
    "a Zenoh connection, for which the inventory has nothing": goal(
        [], [connection(type=2, broker="")]
    ),
    "a broker of a connection that needs none": goal([], [connection(type=2)]),
    "a misspelt node": goal([application(node="egde")]),
    "a node unlike any other": goal([], [connection(ends=("vehicle00", "Mars"))]),
    "an unknown source of a connection": goal([], [connection(ends=("vehicle9", "edge"))]),
    "an unknown source of a topic": goal([application(clouds=[CLOUD, ("/points", "Mars")])]),
    "a broker on a node that has none": goal([], [connection(broker="vehicle00")]),
    "an open broker, with several and none at either end": goal(
        [], [connection(broker="", ends=("vehicle00", "vehicle01"))]
    ),
    "nobody for whom it is asked": goal([application(who=[])], [connection(who=[])]),
    "a requester without a name": goal([application(who=["vehicle00", ""])]),
    "a join with a connection without topics": goal([], [connection(topics=[])]),
    "fewer target topics than source topics": goal(
        [], [connection(topics=["/a", "/b"], targets=["/c"])]
    ),
    "more target topics than source topics": goal(
        [], [connection(topics=["/a"], targets=["/b", "/c"])]
    ),
    "one source topic with two targets": goal(
        [], [connection(topics=["/a", "/a"], targets=["/b", "/c"])]
    ),
    "a topic that would feed itself": goal([], [connection(ends=("edge", "edge"), topics=["/a"])]),
    "ids that climb out of a folder": goal(
        [application("../../clusters")], [connection("a/../b")], id=".."
    ),
    "control characters in ids": goal(
        [application("line\nbreak", who=["nul\0"])],
        [connection("bell\a", who=["escape\x1b[31m"])],
        id="tab\tin",
    ),
    "ids with white space around them": goal(
        [application(" a", who=["b\u3000"])], [connection(" ")], id="c\n"
    ),
    "line separators that only some programs see": goal(
        [application("a\u0085b", who=["a\u2028b", "a\u2029b"])]
    ),
    "half of a character": goal([application("vehicle\ud800")]),
    "ids longer than any name": goal([application("x" * 1025)], [connection("y" * 1025)]),
    "ids that are missing": goal([application("", node="")], [connection("", ends=("", ""))]),
    "a private topic": goal([application(clouds=[("~/points", "vehicle00")])]),
    "a topic longer than ROS takes": goal(
        [], [connection(topics=["/" + "a" * 247], targets=["/a"])]
    ),
    "a topic without a name": goal([application(clouds=[("", "vehicle00")])]),
    "a shutdown of which nothing is held": goal([application()], [connection()], shutdown=True),
}


@pytest.mark.parametrize(
    "topic",
    [
        "/a b", "/a\tb", "/a\nb", "/a'b", '/a"b', "/a$(touch /tmp/x)b", "/a`id`", "/{{ 7 * 7 }}",
        "/{% raw %}", "/a;b", "/a&b", "/a|b", "/a//b", "/a/", "/", "/1a", "/a/1b", "/a-b", "/a.b",
        "/a+b", "/#", "/ü", "/a\0", "/a\u200bb", "/é", "/a\\b", "/{node}", "/*",
    ],
)  # fmt: skip
def test_a_topic_name_that_ros_forbids_is_refused_wherever_it_stands(topic: str) -> None:
    shown = topic if topic.isprintable() else topic.encode("unicode_escape").decode()
    asked = goal(
        [application(ego=[(topic, "vehicle00")], clouds=[(topic, "vehicle00")])],
        [connection(topics=[topic], targets=["/fine"]), connection("2", targets=[topic])],
    )
    assert MemoryRepo().faults(asked) == [
        f"{field}: '{shown}' {ROS_NAMES}"
        for field in (
            f"{BODY}.ego_data_topics[0].topic_name",
            f"{BODY}.pointcloud_topics[0].topic_name",
            "connections[0].source_topics[0]",
            "connections[1].target_topics[0]",
        )
    ]


def test_an_application_without_inputs_is_refused_in_the_words_of_the_wire() -> None:
    (found,) = MemoryRepo().faults(goal([application(clouds=[])]))
    field, _, message = found.partition(": ")
    assert message == "is empty; list at least one topic of ego_data or point_cloud"
    assert field.startswith("apps[0]."), f"the message has no field {field!r}"


def test_without_any_broker_the_file_to_mend_is_told() -> None:
    (found,) = MemoryRepo(brokers()).faults(goal([], [connection(broker="")]))
    field, _, message = found.partition(": ")
    assert field == "connections[0].broker_node_id"
    assert "name one of" not in message
    assert "inventory/brokers.yaml" in message


def test_a_request_for_nothing_is_refused() -> None:
    (found,) = MemoryRepo().faults(goal())
    assert "the request lists no application and no connection; list at least one" in found


def test_a_node_in_no_access_domain_is_refused() -> None:
    path = "policy/access-domains.yaml"
    text = "apiVersion: demandops/v1\nkind: AccessDomains\ndomains:\n  - {name: a, namespace: a, "
    books = MemoryRepo({path: text + 'nodes: ["vehicle*", "station*"]}\n'})
    remedy = "a platform engineer adds it to policy/access-domains.yaml"
    assert books.faults(perception()) == [
        f"apps[0].header.node_id: 'edge' is not in any access domain; {remedy}",
        f"connections[0].target_node_id: 'edge' is not in any access domain; {remedy}",
    ]


class TestContradictions:
    """What stands is kept, and named."""

    @pytest.fixture
    def books(self) -> MemoryRepo:
        books = MemoryRepo()
        books.send(perception())
        return books

    def test_another_node_for_a_claimed_application(self, books: MemoryRepo) -> None:
        assert books.faults(goal([application(node="cloud", who=["vehicle01"])])) == [
            f"apps[0].header.node_id: 'cloud' contradicts an existing claim: '{APP}'"
            " is held by vehicle00 on 'edge'; request that node, or wait until it is released"
        ]

    def test_another_node_for_an_application_that_the_same_demand_claimed(
        self, books: MemoryRepo
    ) -> None:
        assert len(books.faults(goal([application(node="cloud")]))) == 1

    @pytest.mark.parametrize(
        ("changed", "field", "wanted", "held"),
        [
            ({"ends": ("vehicle01", "edge")}, "source_node_id", "vehicle01", "source 'vehicle00'"),
            ({"ends": ("vehicle00", "cloud")}, "target_node_id", "cloud", "target 'edge'"),
            ({"broker": "cloud"}, "broker_node_id", "cloud", "broker 'edge'"),
        ],
    )
    def test_other_ends_or_another_broker_of_a_claimed_connection(
        self, books: MemoryRepo, changed: dict[str, Any], field: str, wanted: str, held: str
    ) -> None:
        assert books.faults(goal([], [connection(who=["vehicle01"], **changed)])) == [
            f"connections[0].{field}: '{wanted}' contradicts an existing claim: 'vehicle00/edge' "
            f"is held by vehicle00 with {held}; use the same {held.partition(' ')[0]}, or another "
            "connection id"
        ]

    def test_another_target_for_a_topic_that_is_carried(self, books: MemoryRepo) -> None:
        asked = connection(who=["vehicle01"], topics=["/new", CLOUD[0]], targets=["/new", "/other"])
        assert books.faults(goal([], [asked])) == [
            f"connections[0].target_topics[1]: '{CLOUD[0]}' goes to '{CLOUD[0]}' already: "
            "'vehicle00/edge' is held by vehicle00; one source topic has one target, use a second "
            "connection"
        ]

    def test_every_contradiction_of_a_request_is_told(self, books: MemoryRepo) -> None:
        asked = goal([application(node="cloud")], [connection(broker="cloud")])
        assert [found.split(":")[0] for found in books.faults(asked)] == [
            "apps[0].header.node_id",
            "connections[0].broker_node_id",
        ]

    def test_two_nodes_for_one_application_in_one_request(self) -> None:
        asked = goal([application(), application(node="cloud")])
        assert [found.split(":")[0] for found in MemoryRepo().faults(asked)] == [
            "apps[1].header.node_id"
        ]

    def test_an_application_that_a_vehicle_holds_is_not_left_half_booked(
        self, books: MemoryRepo
    ) -> None:
        asked = goal(
            [application("new", who=["vehicle01"])],
            [connection(who=["vehicle01"], broker="cloud")],
        )
        books.faults(asked)
        assert books.books()["services"].keys() == {
            "od-edge-vehicle00",
            "of-edge-object-detection-fusion-cf7e0180a8bb",
        }


class TestShutdowns:
    """A shutdown releases what is held, nothing else, and never by guess."""

    def test_a_typo_shows_with_the_claims_that_come_near(self) -> None:
        books = MemoryRepo()
        books.send(perception())
        assert books.faults(goal([application(who=["vehicle01"])], shutdown=True)) == [
            "apps[0].header.id: nothing that the shutdown lists is held; similar claims: "
            "application 'edge/object_detection_fusion' for vehicle00 (request 'request')"
        ]

    def test_a_misspelt_id_shows_what_the_requester_holds(self) -> None:
        books = MemoryRepo()
        books.send(perception())
        assert books.faults(goal([application("edge/fusion")], shutdown=True)) == [
            "apps[0].header.id: nothing that the shutdown lists is held; similar claims: "
            "application 'edge/object_detection_fusion' for vehicle00; "
            "connection 'vehicle00/edge' for vehicle00"
        ]

    def test_a_shutdown_sent_again_does_no_harm(self) -> None:
        books = MemoryRepo()
        books.send(perception())
        who = ["vehicle01"]
        books.send(goal([application("other", who=who)], [connection(who=who)], id="other"))
        assert books.send(perception(shutdown=True)).outcome == "released"
        standing = books.books()
        again = books.send(perception(shutdown=True))
        assert (again.outcome, again.files, books.books()) == ("unchanged", {}, standing)
        assert again.warnings[0].startswith("the same shutdown was carried out at ")

    def test_what_was_not_held_is_named_and_the_rest_released(self) -> None:
        books = MemoryRepo()
        books.send(perception())
        asked = goal(
            [application(), application("nothing")],
            [connection(topics=[CLOUD[0], "/never"])],
            shutdown=True,
        )
        decision = books.send(asked)
        assert decision.outcome == "released"
        assert decision.changes.not_held == (
            "application 'nothing' for vehicle00",
            "connection 'vehicle00/edge': topic /never for vehicle00",
        )
        assert books.books() == {"services": {}, "connections": {}}

    def test_an_unknown_requester_on_shutdown_leaves_nothing_half_booked(self) -> None:
        books = MemoryRepo()
        books.send(perception())
        asked = goal([application(who=["nobody"])], [connection(who=["nobody"])], shutdown=True)
        assert len(books.faults(asked)) == 1
        assert books.books()["connections"]["vehicle00/edge"]["requesters"] == ["vehicle00"]

    def test_the_oldest_claim_gives_first_and_only_the_hold_of_the_one_that_leaves(self) -> None:
        books = MemoryRepo()
        joins = [goal([application(who=["vehicle00", id])], id=id) for id in ("one", "two")]
        books.take_all(joins)
        assert books.send(goal([application()], id="three", shutdown=True)).outcome == "released"
        held = {claim.request: claim.requesters for claim in books.state.ledger}
        assert held == {"one": ("one",), "two": ("two", "vehicle00")}

    def test_what_one_requester_gives_up_stays_for_the_other(self) -> None:
        books = MemoryRepo()
        books.send(goal([application(who=["vehicle00", "station00"])]))
        books.send(goal([application(who=["station00"])], shutdown=True))
        (claim,) = books.state.ledger
        assert claim.requesters == ("vehicle00",)
        books.send(goal([application(who=["vehicle00"])], shutdown=True))
        assert books.books()["services"] == {}


def test_every_fault_of_a_request_is_told_at_once() -> None:
    asked = goal(
        [application("..", node="Mars", who=[], ego=[("/a b", "Mars")], type=7)],
        [connection("", who=[""], ends=("egde", "edge"), topics=["/a"], targets=[], type=5)],
        id="a\nb",
    )
    assert sorted(MemoryRepo().faults(asked)) == sorted(
        [
            r"id: 'a\nb' holds the control character U+000A; choose an id without it",
            "apps[0].header.id: '..' holds '..'; choose an id without it",
            f"apps[0].header.node_id: 'Mars' is not in inventory/nodes.yaml; known: {NODES}",
            f"{BODY}.requester_ids: is empty; list at least one requester",
            f"{BODY}.ego_data_topics[0].topic_name: '/a b' {ROS_NAMES}",
            f"{BODY}.ego_data_topics[0].source_node_id: 'Mars' is not in inventory/nodes.yaml; "
            f"known: {NODES}",
            "apps[0].type: 7 is not a known application type; known: 1 (object-detection-fusion)",
            f"{C0}.id: is empty; give an id",
            f"{C0}.requester_ids[0]: is empty; give an id",
            f"{C0}.source_node_id: 'egde' is not in inventory/nodes.yaml; did you mean 'edge'?",
            f"{C0}.target_topics: has 0 names for 1 in source_topics; source topic i goes to "
            "target topic i, so list as many of each",
            f"{C0}.type: 5 is not a connection type; {TYPES}",
        ]
    )


def test_faults_are_in_the_order_of_the_request() -> None:
    asked = goal([application(who=[]), application("..")], [connection(who=[])], id="\n")
    fields = [found.split(": ")[0] for found in MemoryRepo().faults(asked)]
    assert fields == ["id", f"{BODY}.requester_ids", "apps[1].header.id", f"{C0}.requester_ids"]


def test_a_warning_and_no_refusal_for_an_input_that_no_connection_carries() -> None:
    asked = goal([application(APP, ego=[EGO])], [connection()])
    assert MemoryRepo().send(asked).warnings == (
        "application 'edge/object_detection_fusion': no connection carries ego_data "
        "/vehicles/vehicle00/ego_data of 'vehicle00' to 'edge'",
    )
