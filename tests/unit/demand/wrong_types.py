"""Goals of the wrong form; ``tests/unit/messages`` has the faults of each, with their fields."""

from __future__ import annotations

from typing import Any

from tests.kit.goals import application, connection, goal, perception

NO_ITEM: Any = None
NUMBER: Any = 5
_BEHIND_A_NUMBER = application(clouds=[("/a", "vehicle00"), ("/b c", "vehicle00")])
_BEHIND_A_NUMBER["object_detection_fusion_app"]["pointcloud_topics"][0] = 7

WRONG: dict[str, object] = {
    "no mapping": [],
    "nothing": None,
    "text": "id: x",
    "an unknown field, misspelt": perception(shutdwon=True),
    "an unknown field, unlike any known one": perception(qos=1),
    # a shutdown may have an empty list of topics, so that list is no fault
    "a shutdown that is neither true nor false": goal(
        [application(clouds=[])], [connection(topics=[])]
    )
    | {"shutdown": "yes"},
    "faults of form and of content": goal(
        [application(node="egde", who=["vehicle00", ".."]) | {"typ": 1}],
        [connection(broker="vehicle00", type=300)],
        id="..",
    ),
    "items behind those of the wrong form": goal(
        [NO_ITEM, application(node="egde")], [NUMBER, connection("..")]
    ),
    "a requester behind one of the wrong form": goal([application(who=[NUMBER, "fine", ".."])]),
    "a topic behind one of the wrong form": goal([_BEHIND_A_NUMBER]),
    "lists of one length, with a wrong item": goal(
        [], [connection(topics=[NUMBER, "/a"], targets=["/b", "/c"])]
    ),
    "a number for a list, which is no empty list": {"id": "x", "apps": 5},
    "keys that are no text": {**perception(), 1: "x", None: "x", 1.5: "x", (1, 2): "x"},
}
