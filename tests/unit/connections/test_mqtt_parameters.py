"""The parameters of MQTT clients carry each topic from its source to its target."""

from __future__ import annotations

import re
from typing import Any

import yaml

from tests.kit.goals import connection, goal
from tests.kit.memory import MemoryRepo

LISTS = {"ros2mqtt": "ros_topics", "mqtt2ros": "mqtt_topics"}


def ends(books: MemoryRepo) -> dict[str, dict[str, Any]]:
    """Return each client's parameters, by the client's name."""
    found = {}
    for name, config in books.objects("ConfigMap").items():
        whole = yaml.safe_load(config["data"]["params.yaml"])
        assert whole.keys() == {"/**/*"}
        assert whole["/**/*"].keys() == {"ros__parameters"}
        found[name] = whole["/**/*"]["ros__parameters"]
    return found


def carried(books: MemoryRepo) -> dict[str, dict[tuple[str, str], str]]:
    """Follow each topic through both clients of its connection, and return where it arrives.

    The result maps each connection to a map from (ROS topic at the source, MQTT topic) to the ROS
    topic at the target.
    """
    deployments = books.objects("Deployment")
    ways: dict[str, dict[str, dict[str, str]]] = {}
    for name, parameters in ends(books).items():
        id = deployments[name]["metadata"]["annotations"]["demandops/connection"]
        for way, bridge in parameters["bridge"].items():
            listed = bridge[LISTS[way]]
            assert listed == sorted(set(listed))
            assert bridge.keys() == {LISTS[way], *listed}
            field = "mqtt_topic" if way == "ros2mqtt" else "ros_topic"
            for topic in listed:
                ways.setdefault(id, {}).setdefault(way, {})[topic] = bridge[topic][field]
    return {
        id: {(source, mqtt): sides["mqtt2ros"][mqtt] for source, mqtt in sides["ros2mqtt"].items()}
        for id, sides in ways.items()
    }


def pairs(books: MemoryRepo, id: str) -> dict[str, str]:
    return {source: target for (source, _), target in carried(books)[id].items()}


def test_two_source_topics_may_arrive_as_one() -> None:
    books = MemoryRepo()
    books.send(goal([], [connection("c", topics=["/a", "/b"], targets=["/c", "/c"])]))
    assert pairs(books, "c") == {"/a": "/c", "/b": "/c"}


def test_topics_are_united_over_the_claims_and_parted_again() -> None:
    books = MemoryRepo()
    books.send(goal([], [connection("c", topics=["/b", "/a"], targets=["/y", "/x"])], id="1"))
    alone = books.rendered()
    books.send(goal([], [connection("c", topics=["/a", "/c"], targets=["/x", "/z"])], id="2"))
    assert pairs(books, "c") == {"/a": "/x", "/b": "/y", "/c": "/z"}
    books.send(goal([], [connection("c", topics=["/c"], targets=["/z"])], id="2", shutdown=True))
    assert pairs(books, "c") == {"/a": "/x", "/b": "/y"}
    assert books.rendered() == alone
    books.send(goal([], [connection("c", topics=[])], id="1", shutdown=True))
    assert pairs(books, "c") == {"/a": "/x"}
    books.send(goal([], [connection("c", topics=[])], id="2", shutdown=True))
    assert books.rendered() == {}


def test_two_connections_with_one_topic_name_share_no_mqtt_topic() -> None:
    books = MemoryRepo()
    for id in ("c", "c/d", "c_d", "C"):
        books.send(goal([], [connection(id, topics=["/d", "/c/d"])], id=id))
    mqtt = [topic for ways in carried(books).values() for _, topic in ways]
    assert len(mqtt) == len(set(mqtt)) == 8


def test_no_mqtt_topic_holds_a_wildcard_or_a_dollar() -> None:
    books = MemoryRepo()
    for id in ("+", "#", "$SYS/x", "a/+/b", "/", "//"):
        books.send(goal([], [connection(id)], id=id))
    for ways in carried(books).values():
        for _, mqtt in ways:
            assert re.fullmatch(r"[a-z0-9-]+(/[A-Za-z0-9_]+)+", mqtt), mqtt


def test_the_client_id_of_each_end_is_unique_and_the_name_of_its_deployment() -> None:
    books = MemoryRepo()
    for id in ("c", "c-source", "c/source", "C"):
        books.send(goal([], [connection(id)], id=id))
    found = ends(books)
    assert len(found) == 8
    assert all(parameters["client"]["id"] == name for name, parameters in found.items())
    assert found.keys() == books.objects("Deployment").keys()


def test_new_topics_restart_both_ends_and_nothing_else_does() -> None:
    books = MemoryRepo()
    books.send(goal([], [connection("c", topics=["/a"])], id="1"))
    templates = {n: d["spec"]["template"] for n, d in books.objects("Deployment").items()}
    books.send(goal([], [connection("c", topics=["/a"], who=["vehicle01"])], id="2"))
    assert templates == {n: d["spec"]["template"] for n, d in books.objects("Deployment").items()}
    books.send(goal([], [connection("c", topics=["/b"])], id="3"))
    for name, deployment in books.objects("Deployment").items():
        assert deployment["spec"]["template"] != templates[name]
