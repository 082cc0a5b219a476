"""The joins that `demandops import` finds in the reference's files, with counts and requesters."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from random import Random
from typing import Any

import pytest
from demandops.errors import InvalidInput
from demandops.migration import imported_goals, reference_files
from demandops.migration.reference_files import Hold, ReferenceFiles
from demandops.migration.reference_map import MappedApplication, ReferenceMap
from demandops.migration.remaining_joins import Join
from demandops.settings import API_VERSION
from hypothesis import given

from tests.kit import plain_yaml
from tests.kit.chance import chances, examples
from tests.kit.goals import EXPERIMENT, application, connection
from tests.kit.reference import Reference

RUN = plain_yaml.load((Path(__file__).parents[2] / "fixtures/reference-run.yaml").read_text())[
    "steps"
]
CONNECTION, FUSION = "mqtt-connection-station00-edge", "of-edge-object-detection-fusion"


def after(*goals: dict[str, Any]) -> Reference:
    reference = Reference()
    for goal in goals:
        reference.send(goal)
    return reference


def read(reference: Reference, *wanted: str) -> ReferenceFiles:
    """Read the reference's files whose names contain one of the ``wanted`` texts."""
    texts = {
        name: text for name, text in reference.texts().items() if any(w in name for w in wanted)
    }
    return reference_files.read((name, plain_yaml.load(text)) for name, text in texts.items())


def experiment(steps: int) -> Reference:
    return after(*(plain_yaml.load(path.read_text()) for path in EXPERIMENT[:steps]))


def holds(joins: list[Join]) -> Counter[Hold]:
    return Counter(
        (topic, who) for join in joins for who in join.requesters for topic in join.topics
    )


def who(joins: list[Join]) -> list[tuple[str, ...]]:
    return [join.requesters for join in joins]


def test_the_stand_in_keeps_the_books_of_the_recorded_run() -> None:
    recorded: dict[str, list[str]] = {}
    for step, path in enumerate(EXPERIMENT):
        assert RUN[step]["goal"] == f"examples/experiment/{path.name}"
        recorded |= RUN[step]["books"]
        books = read(experiment(step + 1), "bookkeeping").books.items()
        assert {
            f"{name} {topic}".strip(): sorted(who for t, who in book.elements() if t == topic)
            for name, book in books
            for topic, _ in book
        } == {name: requesters for name, requesters in recorded.items() if requesters}


def test_the_versioning_files_tell_who_joined_together() -> None:
    joins, warnings = imported_goals.remaining_joins(read(experiment(6), ".yml"))
    pairs = [("vehicle03", "station00"), ("vehicle02", "station00")]
    assert who(joins[CONNECTION]) == who(joins[FUSION]) == pairs
    assert warnings == []


def test_an_import_without_the_remaining_joins_keeps_the_counts() -> None:
    joins, _ = imported_goals.remaining_joins(read(experiment(6), "bookkeeping"))
    assert who(joins[CONNECTION]) == [("vehicle03", "station00", "vehicle02"), ("station00",)]


@examples(30)
@given(chances)
def test_after_any_goals_the_holds_are_those_of_the_bookkeeping(chance: Random) -> None:
    reference = after(*_goals(chance))
    books = read(reference, "bookkeeping").books
    for wanted in ("bookkeeping", ".yml", ""):
        joins, warnings = imported_goals.remaining_joins(read(reference, wanted))
        assert {name: holds(joins[name]) for name in joins} == {
            name: book for name, book in books.items() if not name.startswith("od-")
        }
        assert all(
            count == 1
            for theirs in joins.values()
            for join in theirs
            for count in holds([join]).values()
        )
        assert warnings == []


def _goals(chance: Random) -> list[dict[str, Any]]:
    """Return random joins, and shutdowns of some of them."""
    goals, open_ = list[dict[str, Any]](), list[dict[str, Any]]()
    for number in range(chance.randrange(1, 15)):
        if open_ and chance.random() < 0.4:
            goals.append(open_.pop(chance.randrange(len(open_))) | {"shutdown": True})
            continue
        # each goal differs, because the cluster reports no change if a goal is repeated
        requesters = [f"r{number}", *chance.sample(["v0", "v1", "s0"], chance.randrange(3))]
        ego = chance.sample([("/e0", "v0"), ("/e1", "v1")], chance.randrange(3))
        ends = chance.sample(["vehicle00", "station00"], chance.randrange(3))
        goal = {
            "id": str(number),
            "apps": [application(who=requesters, ego=ego)] if ego else [],
            "connections": [
                connection(f"{end}/edge", who=requesters, ends=(end, "edge"), topics=["/t"])
                for end in ends
            ],
        }
        goals.append(goal)
        open_.append(goal)
    return goals


def test_the_versioning_of_a_fusion_shows_its_holders() -> None:
    joins, _ = imported_goals.remaining_joins(read(experiment(6), "object_fusion_versioning"))
    assert who(joins[FUSION]) == [("vehicle03", "station00"), ("vehicle02", "station00")]


def test_the_versioning_of_a_connection_does_not_show_its_holders() -> None:
    """The first request in the versioning file lists all later requesters too."""
    files = read(experiment(3), "mqtt_versioning")
    first, *_ = files.versions[CONNECTION].values()
    assert first.requester == ["vehicle00", "station00", "vehicle01", "station00"]
    with pytest.raises(InvalidInput) as refused:
        imported_goals.remaining_joins(files)
    assert str(refused.value) == (
        f"{CONNECTION}: has requests, but no bookkeeping. The requests alone do not tell who holds "
        "the connection, because the reference's operator adds each later requester to the first "
        "request. Give an mqtt_bookkeeping.yml that has the connection. If this file is lost, "
        "write one that lists each requester as often as it holds the connection, such as "
        f"'{CONNECTION}: [vehicle00]'"
    )


def test_a_topic_that_the_map_lacks_is_named_where_it_belongs() -> None:
    joins = {FUSION: [Join(1, ("vehicle00",), ("/ego_data", "/station00_local_objectlist"))]}
    app = MappedApplication(id="edge/fusion", node="edge")
    head: Any = {"apiVersion": API_VERSION, "kind": "ReferenceMap"}
    mapped = ReferenceMap(**head, request="imported", applications={FUSION: app})
    with pytest.raises(InvalidInput) as refused:
        imported_goals.goals(joins, mapped, "map.yaml")
    assert [one.field for one in refused.value.faults] == [
        f"applications.{FUSION}.egoData./ego_data",
        f"applications.{FUSION}.pointClouds./station00_local_objectlist",
    ]


def test_a_deleted_application_is_not_imported_although_its_versions_remain() -> None:
    reference = experiment(8)
    files = read(reference, "")
    assert FUSION in files.versions
    assert imported_goals.remaining_joins(files) == ({}, [])


def test_resources_alone_give_the_requesters_of_the_last_request() -> None:
    joins, warnings = imported_goals.remaining_joins(read(experiment(5), "resources"))
    assert {name: who(found) for name, found in joins.items()} == {
        f"mqtt-connection-vehicle0{number}-edge": [(f"vehicle0{number}", "station00")]
        for number in (1, 2, 3)
    }
    assert warnings[0] == (
        f"{CONNECTION} is not imported, because its last request was a shutdown and the "
        "bookkeeping files do not say who still holds it"
    )
    assert warnings[1] == (
        "mqtt-connection-vehicle01-edge: the bookkeeping files do not say who holds it, so only "
        "the requesters that its last request lists are imported, each with one hold"
    )
    assert warnings[-1] == (
        "od-edge-station00 is not imported, because no application reads its object list"
    )
