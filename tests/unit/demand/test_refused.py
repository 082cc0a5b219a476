"""Demands that are refused.

``tests/unit/messages`` has the messages for the tables ``REFUSED`` and ``CONTRADICTING``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import yaml
from demandops.base import naming
from demandops.base.errors import MOST_FAULTS, Refused, suggestion
from demandops.model.demand import demand_goal

from tests.kit.config import brokers, skeleton
from tests.kit.goals import (
    BODY,
    CLOUD,
    ROS_NAMES,
    Goal,
    application,
    connection,
    goal,
    perception,
    put,
)
from tests.kit.memory import MemoryRepo


def placed(place: Goal, node: str = "", application: str = "fusion") -> Goal:
    """Return a demand whose application has this ``place``."""
    made = put("d", "vehicle01")
    made["applications"][0] |= {"place": place, "node": node, "id": application}
    return made


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
    "a broker on a node that has none": goal(
        [], [connection(broker="station00", ends=("vehicle00", "vehicle01"))]
    ),
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
    "an application without inputs": goal([application(clouds=[])]),
    "nothing": goal(),
    "a place that no node has": placed(
        {"role": "vehicle", "labels": ["a=b"], "capabilities": ["x"]}
    ),
    "a role that no node has": placed({"role": "egde"}),
    "a label without a value, a capability without a name": placed(
        {"labels": ["zone"], "capabilities": [""]}
    ),
    "a node without what the place asks for": placed({"role": "edge"}, node="cloud"),
    "neither a node nor a place": placed({}),
    "positions twice, and of an unknown node": placed({"role": "edge"})
    | {"positions": [{"node": node, "x": 1, "y": 2} for node in ("edge", "egde", "edge")]},
    "a priority, and positions of a release": {
        "kind": "Demand",
        "operation": "release",
        "demand": "d",
        "requesters": ["vehicle00"],
        "priority": 1,
        "positions": [{"node": "edge", "x": 1, "y": 2}],
    },
    "two nodes for one application": goal([application(), application(node="cloud")]),
    "many faults, told in the order of the request": goal(
        [
            application("..", node="Mars", who=[], ego=[("/a b", "Mars")], type=7),
            application("\n"),
        ],
        [connection("", who=[""], ends=("egde", "edge"), topics=["/a"], targets=[], type=5)],
        id="a\nb",
    ),
}

OTHER = ["vehicle01"]
CONTRADICTING: dict[str, Goal] = {
    "another node for an application": goal([application(node="cloud", who=OTHER)]),
    "another node for what the same demand holds": goal([application(node="cloud")]),
    "another source": goal([], [connection(who=OTHER, ends=("vehicle01", "edge"))]),
    "another target": goal([], [connection(who=OTHER, ends=("vehicle00", "cloud"))]),
    "another broker": goal([], [connection(who=OTHER, broker="cloud")]),
    "another target for a topic that is carried": goal(
        [], [connection(who=OTHER, topics=["/new", CLOUD[0]], targets=["/new", "/other"])]
    ),
    "a place that its node does not have": placed(
        {"role": "cloud"}, application="edge/object_detection_fusion"
    ),
    "several contradictions": goal([application(node="cloud")], [connection(broker="cloud")]),
    "a shutdown by another requester": goal([application(who=OTHER)], shutdown=True),
    "a shutdown with a misspelt id": goal([application("edge/fusion")], shutdown=True),
}
"""Goals that are refused after ``perception()`` is booked."""


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


def test_without_any_broker_the_file_to_mend_is_told() -> None:
    (found,) = MemoryRepo(brokers()).faults(goal([], [connection(broker="")]))
    field, _, message = found.partition(": ")
    assert field == "connections[0].broker_node_id"
    assert "name one of" not in message
    assert "inventory/brokers.yaml" in message


def test_a_node_in_no_access_domain_is_refused() -> None:
    path = "policy/access-domains.yaml"
    text = "apiVersion: demandops/v1\nkind: AccessDomains\ndomains:\n  - {name: a, namespace: a, "
    books = MemoryRepo({path: text + 'nodes: ["vehicle*", "station*"]}\n'})
    remedy = "a platform engineer adds it to policy/access-domains.yaml"
    assert books.faults(perception()) == [
        f"apps[0].header.node_id: 'edge' is not in any access domain; {remedy}",
        f"connections[0].target_node_id: 'edge' is not in any access domain; {remedy}",
    ]


def test_a_shutdown_lists_unclaimed_subjects_and_releases_the_rest() -> None:
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


def test_a_shutdown_releases_its_requester_from_the_oldest_claim_only() -> None:
    books = MemoryRepo()
    books.take_all(goal([application(who=["vehicle00", id])], id=id) for id in ("one", "two"))
    assert books.send(goal([application()], id="three", shutdown=True)).outcome == "released"
    left = sorted(claim.requesters for claim in books.state.ledger)
    assert left == [("one",), ("two", "vehicle00")]


def test_a_shutdown_sent_again_changes_nothing_and_says_so() -> None:
    books = MemoryRepo()
    books.send(perception())
    books.send(perception(id="other"))
    assert books.send(perception(shutdown=True)).outcome == "released"
    standing = books.books()
    again = books.send(perception(shutdown=True))
    assert (again.outcome, again.files, books.books()) == ("unchanged", {}, standing)
    assert again.warnings[0].startswith("the same shutdown was carried out at ")


def limited(**limits: int) -> MemoryRepo:
    """Return a state repo with these ``limits`` in its demandops.yaml."""
    settings = yaml.safe_load(skeleton()["demandops.yaml"])
    return MemoryRepo({"demandops.yaml": yaml.safe_dump(settings | {"limits": limits})})


def test_a_demand_that_lists_too_much_is_refused_at_once() -> None:
    count = 10_000
    clouds = [(f"/a/b{i}", "vehicle00") for i in range(count)]
    assert MemoryRepo().faults(goal([application(clouds=clouds)])) == [
        ": lists more than 10000 items (applications, connections, topics, requesters and so on, "
        "also of the connections that it needs), but at most 10000 are allowed; a platform "
        "engineer may raise limits.demandItems in demandops.yaml"
    ]


@pytest.mark.parametrize("key", ["k{}".format, int])
def test_a_demand_with_too_many_fields_is_refused_at_once(key: Callable[[int], Any]) -> None:
    fields = {key(number): 0 for number in range(2_000)}
    refused = MemoryRepo().take(put("d") | {"applications": [fields] * 60})
    assert isinstance(refused, Refused)
    assert [found.code for found in refused.faults] == ["too-large"]


def test_of_many_faults_of_form_the_first_are_told() -> None:
    fields = {f"k{number}": 0 for number in range(2_000)}
    refused = MemoryRepo().take(put("d") | {"applications": [fields] * 2})
    assert isinstance(refused, Refused)
    assert len(refused.faults) == MOST_FAULTS
    assert "applications[0].k0" in {found.field for found in refused.faults}


def test_every_item_of_a_demand_counts_towards_the_limit() -> None:
    item = goal([], [connection(topics=["/a", "/b"])])
    assert limited(demandItems=4).send(item).outcome == "booked"
    assert len(limited(demandItems=3).faults(item)) == 1


def test_a_file_that_would_grow_too_large_is_refused_and_may_shrink() -> None:
    topics = [f"/topic_{i}" for i in range(30)]
    refused = limited(fileBytes=1000).take(goal([], [connection(topics=topics)]))
    assert isinstance(refused, Refused)
    assert {found.file.split("/")[0] for found in refused.faults} == {"clusters"}
    assert all("at most 1000 are allowed" in found.message for found in refused.faults)
    repo = MemoryRepo()
    repo.send(goal([], [connection(topics=topics)]))
    small = limited(fileBytes=1000)
    small.state, small.files = replace(small.state, ledger=repo.state.ledger), repo.files
    small.send(goal([], [connection(topics=topics[:1])], shutdown=True))


def test_parameters_are_bounded() -> None:
    demand = {"kind": "Demand", "demand": "d", "requesters": ["vehicle00"]}
    app = {"id": "a", "type": "object-detection-fusion", "node": "edge"}
    (found, *_) = MemoryRepo().faults(
        demand | {"applications": [app | {"parameters": {"use_sim_time": "x" * 100_000}}]}
    )
    assert found.startswith("applications[0].parameters: have 100020 bytes, but at most 100000 are")


def test_of_many_faults_the_first_are_told_and_the_others_counted() -> None:
    found = MemoryRepo().faults(goal([], [connection(topics=["/a b"] * 150)]))
    assert len(found) == 101
    assert found[-1] == ": has 200 more faults"
    (found, *_) = MemoryRepo().faults(goal([]) | {"x" * 10**6: 1})
    assert len(found) < 10_000


@pytest.mark.nightly
def test_similar_names_are_found_soon_however_many_words_are_unknown() -> None:
    names = [f"vehicle-{number:04}" for number in range(1000)]
    before = time.thread_time()
    found = {suggestion(f"vehicel-{number:04}", names) for number in range(0, 1000, 2)}
    assert time.thread_time() - before < 5  # it once took half a minute
    assert len(found) > 100
    for word in ("vehicle-0123x", "xehicle-0123", "vehicle-123"):
        assert suggestion(word, names) == "; did you mean 'vehicle-0123'?"


def test_names_are_made_once_for_each_of_many_topics() -> None:
    count, repo = 300, MemoryRepo()
    clouds = [{"topic": f"/c{number}", "source": "vehicle00"} for number in range(count)]
    made = put("many")
    made["applications"][0]["inputs"] = {"point_cloud": clouds}
    before = naming.topic_part.cache_info()
    assert repo.send(made).outcome == "booked"
    after = naming.topic_part.cache_info()
    assert after.hits + after.misses - before.hits - before.misses < 50 * count


@pytest.mark.parametrize(
    ("written", "told"),
    [
        ("[" * 100_000 + "]" * 100_000, "is nested deeper than 50 levels; make it flatter"),
        ("9" * 5_000, "has an integer of too many digits; write a shorter one"),
        ("fast", 'is not JSON; text needs its own quotes, as in "\\"fast\\""'),
    ],
)
def test_a_json_text_that_cannot_be_read_is_told_why(written: str, told: str) -> None:
    made = put("d", "vehicle01")
    made["applications"][0]["parameters_json"] = {"rate": written}
    found = [one.message for one in demand_goal.parse(made)[1]]
    assert found == [told]
