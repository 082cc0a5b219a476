"""A goal of the wrong form: every fault is told at its own place, with those of the content."""

from __future__ import annotations

from tests.kit.goals import BODY, application, connection, goal, perception
from tests.kit.memory import MemoryRepo

WRONG: dict[str, object] = {
    "no mapping": [],
    "nothing": None,
    "text": "id: x",
    "an unknown field, misspelt": perception(shutdwon=True),
    "an unknown field, like none": perception(qos=1),
}


def test_a_shutdown_that_is_no_truth_value_is_not_judged_as_a_join() -> None:
    """Whether it joins or leaves is not known, so a topic list may be empty."""
    asked = goal([application(clouds=[])], [connection(topics=[])]) | {"shutdown": "yes"}
    assert [message.split(": ")[0] for message in MemoryRepo().faults(asked)] == ["shutdown"]


def test_faults_of_form_and_of_content_are_told_together() -> None:
    asked = goal(
        [application(node="egde", who=["vehicle00", ".."]) | {"typ": 1}],
        [connection(broker="vehicle00", type=300)],
        id="..",
    )
    assert sorted(message.split(": ")[0] for message in MemoryRepo().faults(asked)) == sorted(
        [
            "apps[0].typ",
            "connections[0].type",
            "id",
            "apps[0].header.node_id",
            f"{BODY}.requester_ids[1]",
        ]
    )


def test_a_fault_keeps_its_place_behind_an_item_of_the_wrong_form() -> None:
    asked = goal(
        [None, application(node="egde")],  # type: ignore[list-item]
        [5, connection("..")],  # type: ignore[list-item]
    )
    fields = sorted(message.split(": ")[0] for message in MemoryRepo().faults(asked))
    assert fields == ["apps[0]", "apps[1].header.node_id", "connections[0]", "connections[1].id"]


def test_a_requester_keeps_its_place_behind_one_of_the_wrong_form() -> None:
    found = MemoryRepo().faults(goal([application(who=[5, "fine", ".."])]))  # type: ignore[list-item]
    assert found == [
        f"{BODY}.requester_ids[0]: must be text, not 5; put it in quotes",
        f"{BODY}.requester_ids[2]: '..' holds '..'; choose an id without it",
    ]


def test_a_topic_keeps_its_place_behind_one_of_the_wrong_form() -> None:
    app = application(clouds=[("/a", "vehicle00"), ("/b c", "vehicle00")])
    app["object_detection_fusion_app"]["pointcloud_topics"][0] = 7
    fields = [message.split(": ")[0] for message in MemoryRepo().faults(goal([app]))]
    assert fields == [f"{BODY}.pointcloud_topics[0]", f"{BODY}.pointcloud_topics[1].topic_name"]


def test_lists_of_one_length_are_not_told_to_differ_for_a_wrong_item() -> None:
    asked = goal([], [connection(topics=[5, "/a"], targets=["/b", "/c"])])  # type: ignore[list-item]
    assert MemoryRepo().faults(asked) == [
        "connections[0].source_topics[0]: must be text, not 5; put it in quotes"
    ]


def test_what_is_not_told_to_be_missing_because_its_list_has_the_wrong_form() -> None:
    """``apps: 5`` is one fault; that nothing is listed then is not another."""
    found = MemoryRepo().faults({"id": "x", "apps": 5})
    assert [message.split(": ")[0] for message in found] == ["apps"]


def test_keys_that_are_no_text_are_told() -> None:
    for key in (1, None, True, 1.5, (1, 2)):
        (found, *_) = MemoryRepo().faults({**perception(), key: "x"})
        assert "key" in found or "field" in found, found
