"""The ledger counts requesters as the reference's operators do, of whom a run is recorded."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

from demandops.model.ledger.ledger import Ledger

from tests.kit import plain_yaml
from tests.kit.memory import NOW, MemoryRepo

ROOT = Path(__file__).parents[3]
RUN = plain_yaml.load((ROOT / "tests" / "fixtures" / "reference-run.yaml").read_text())
ROW = re.compile(r"^\| `([\w-]+)` \|", re.MULTILINE)
FURTHER_CLOUD = re.compile(r"^/([a-z]+\d\d)_.+(_local_objectlist)$")

Books = dict[str, list[str]]


def resource(kind: str, *ids: str) -> str:
    return "-".join((kind, *ids)).replace("_", "-").replace("/", "-")


def counted(ledger: Ledger) -> Books:
    """Return the sorted requesters of each resource of the reference, of a fusion for each topic.

    A requester is listed once for each of its claims on the resource.
    """
    books = defaultdict[str, list[str]](list)
    for claim in ledger:
        if not claim.is_on_application:
            # the reference derives no connection, and knows a topic by the id that lists it
            topics = (topic for topic in claim.connection.topics if not topic.implied)
            for id in {topic.listed or claim.subject.id for topic in topics}:
                books[resource("mqtt-connection", id)] += claim.requesters
            continue
        fusion = resource("of", claim.subject.id)
        for key in claim.held.topic_keys():
            role, topic, source = key
            if role == "point_cloud":
                topic = f"/{source}_local_objectlist"
                books[resource("od", claim.application.node, source)] += claim.requesters
            books[f"{fusion} {topic}"] += claim.requesters
    return {name: sorted(who) for name, who in books.items()}


def running(repo: MemoryRepo) -> Books:
    """Return the topics of each service and connection.

    The keys are the names of the reference's resources. The reference has one detection for all
    point clouds of a source, so the topics of a source's detections are listed together.
    """
    runs, books = defaultdict[str, set[str]](set), repo.bookkeeping()
    for service in books["services"].values():
        topics = {topic for role in service["inputs"].values() for topic in role}
        if service["source"] is None:
            (id,) = service["applications"]
            runs[resource("of", id)] = {FURTHER_CLOUD.sub(r"/\1\2", topic) for topic in topics}
        else:
            runs[resource("od", service["node"], service["source"])] |= topics
    for id, entry in books["connections"].items():
        for topic in entry["topics"]:
            for listed in entry.get("listed", {}).get(topic, [id]):
                if not listed.startswith("derived/"):  # the reference has none
                    runs[resource("mqtt-connection", listed)].add(topic)
    return {name: sorted(topics) for name, topics in runs.items()}


def recorded(name: str) -> Iterator[Books]:
    """Yield a table that DemandOps must have after each step of the recorded run.

    ``name`` is ``books`` (who requests what) or ``runs``. The record of a step lists only changes:
    changed entries of the reference's table, and entries that begin or cease to differ here.
    """
    theirs, differs = dict[str, list[str]](), dict[str, Any]()
    for step in RUN["steps"]:
        theirs = present(theirs | step.get(name, {}))
        differs |= step.get(f"{name}_here", {})
        differs = {entry: what for entry, what in differs.items() if what != "same"}
        for entry, what in differs.items():
            assert what != theirs.get(entry), f"{entry} does not differ here"
        yield present(theirs | differs)


def present(books: dict[str, Any]) -> Books:
    return {name: what for name, what in books.items() if what is not None}


def test_what_comes_of_a_recorded_run_of_the_reference_here() -> None:
    repo, both = MemoryRepo(), zip(recorded("books"), recorded("runs"), strict=True)
    for number, (step, (books, runs)) in enumerate(zip(RUN["steps"], both, strict=True), 1):
        wanted = step["goal"]
        if isinstance(wanted, str):
            wanted = plain_yaml.load((ROOT / wanted).read_text())
        repo.take(wanted, NOW + timedelta(minutes=2 * number))
        assert counted(repo.state.ledger) == books, number
        assert running(repo) == runs, number


def test_the_recorded_run_shows_every_difference_that_the_page_explains() -> None:
    page = (ROOT / "docs" / "reference.md").read_text()
    assert RUN["reference"]["commit"] in page
    explained = ROW.findall(page)
    assert sorted(explained) == sorted({step["class"] for step in RUN["steps"] if "class" in step})
