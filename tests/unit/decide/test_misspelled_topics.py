"""A topic gives a warning only if it is probably a misspelling of a known topic."""

from __future__ import annotations

import pytest
from demandops.decide import warnings

from tests.kit.goals import put
from tests.kit.memory import MemoryRepo

USUAL = "/vehicles/vehicle00/drivers/lidar/pointcloud"


def told(topic: str, *known: str) -> list[str]:
    """Return the warnings about spelling that a demand for ``topic`` gives.

    Before it, other demands for the topics ``known`` are booked.
    """
    books = MemoryRepo()
    for number, one in enumerate(known):
        books.send(_demand(f"known-{number}", one))
    warnings = books.send(_demand("own", topic)).warnings
    return [one for one in warnings if "did you mean" in one]


def _demand(id: str, topic: str, source: str = "vehicle00") -> dict[str, object]:
    inputs = {"point_cloud": [{"topic": topic, "source": source}]}
    app = {"id": f"edge/{id}", "type": "object-detection-fusion", "node": "edge"}
    return put(id, id, applications=[app | {"inputs": inputs}], connections=[])


@pytest.mark.parametrize("wrong", ["pontcloud", "pointcluod", "pointclouds", "pointCloud"])
def test_it_is_told_with_the_topic_of_the_inventory(wrong: str) -> None:
    topic = USUAL.replace("pointcloud", wrong)
    assert told(topic) == [
        f"application 'edge/own': 'vehicle00' is not known to publish {topic}; did you mean "
        f"'{USUAL}'?"
    ]


@pytest.mark.parametrize(
    ("topic", "known"),
    [
        (USUAL, []),
        (f"{USUAL}2", []),
        (USUAL.replace("lidar", "camera"), []),
        ("/cameras/front_l", ["/cameras/front_r"]),
        ("/local_objects", ["/global_objects"]),
    ],
)
def test_another_topic_is_no_mistake(topic: str, known: list[str]) -> None:
    assert told(topic, *known) == []


def test_a_node_without_topics_in_the_inventory_has_those_of_earlier_demands() -> None:
    books = MemoryRepo()
    books.send(_demand("known", "/objects", "cloud"))
    told = books.send(_demand("own", "/objcts", "cloud")).warnings
    assert any("did you mean '/objects'?" in one for one in told)


def test_check_tells_of_it_with_the_file_of_the_claim() -> None:
    books = MemoryRepo()
    link = {"id": "own/link", "type": "mqtt", "source": "vehicle00", "target": "edge"}
    link |= {"topics": [{"source": USUAL.replace("vehicles", "vehicle")}]}
    books.send(put("own", "own", applications=[], connections=[link]))
    (found,) = warnings.misspelled_topic_warnings(books.state)
    assert found.file.startswith("ledger/connections/")
    assert f"did you mean '{USUAL}'?" in found.message
