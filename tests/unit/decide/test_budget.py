"""A demand causes a bounded amount of work, however it is made, and so does a merged file.

Work is counted in calls of functions and in looks at the clock, so the tests need no clock.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import yaml
from demandops.base.errors import Fault, InvalidInput, OverBudget, Refused
from demandops.decide.decision import decide
from demandops.decide.placement.placement import MOST_ATTEMPTS
from demandops.model.config.load import load
from rpds import HashTrieMap

from tests.kit import plain_yaml
from tests.kit.config import configuration, override, skeleton
from tests.kit.goals import Goal, application, connection, goal, perception
from tests.kit.memory import MemoryRepo

ENDS = ("vehicle00", "edge")


def repo(edges: int = 0, files: dict[str, str] | None = None, **limits: int) -> MemoryRepo:
    """Return a repo with so many edges more, e000 and so on, and with these limits."""
    settings = yaml.safe_load(skeleton()["demandops.yaml"]) | {"limits": limits}
    nodes = [{"id": f"e{n:03}", "type": "edge", "cluster": "c-its"} for n in range(edges)]
    more = {"apiVersion": "demandops/v1", "kind": "Nodes", "nodes": nodes}
    return MemoryRepo(
        {"demandops.yaml": yaml.safe_dump(settings)}
        | ({"inventory/nodes/edges.yaml": yaml.safe_dump(more)} if nodes else {})
        | (files or {})
    )


def app(number: int, topics: int = 1, **more: Any) -> dict[str, Any]:
    names = (f"/t{number}/n{index}" for index in range(topics))
    inputs = {"ego_data": [{"topic": name, "source": "vehicle00"} for name in names]}
    made = {"id": f"a{number}", "type": "object-detection-fusion", "inputs": inputs}
    return made | ({} if "node" in more else {"place": {"role": "edge"}}) | more


def link(number: int, ends: tuple[str, str] = ENDS, topics: int = 1) -> dict[str, Any]:
    listed = [{"source": f"/c{number}/n{index}"} for index in range(topics)]
    made = {"id": f"c{number}", "type": "mqtt", "source": ends[0], "target": ends[1]}
    return made | {"topics": listed}


def demand(
    apps: Iterable[dict[str, Any]] = (),
    links: Iterable[dict[str, Any]] = (),
    who: Iterable[str] = ("attacker",),
    **more: Any,
) -> Goal:
    made = {"kind": "Demand", "demand": "d", "requesters": [*who]}
    return made | {"applications": [*apps], "connections": [*links]} | more


def codes(answer: object) -> set[str]:
    assert isinstance(answer, Refused)
    return {fault.code for fault in answer.faults}


@contextmanager
def counted(calls: list[int]) -> Iterator[None]:
    def count(*_: object) -> None:
        calls[0] += 1

    sys.setprofile(count)
    try:
        yield
    finally:
        sys.setprofile(None)


def work_of(books: MemoryRepo, made: Goal) -> tuple[int, int, object]:
    """Return all calls of a decision, the most between two looks at the clock, and the answer."""
    calls, looks = [0], list[int]()
    answer: object
    with counted(calls):
        try:
            answer = decide(
                *(books.state, made, books.now, books.files.get),
                checkpoint=lambda: looks.append(calls[0]),
            )
        except Refused as refused:
            answer = refused
    ends = [0, *looks, calls[0]]
    return calls[0], max(b - a for a, b in pairwise(ends)), answer


@pytest.mark.parametrize(
    ("refused", "code"),
    [
        (link(0, ("vehicle01", "edge")), "conflict"),
        (link(1, ("vehicle00", "vehicle01")), "no-broker"),
    ],
)
def test_what_no_node_changes_is_not_tried_on_each_node(refused: dict[str, Any], code: str) -> None:
    work = []
    for edges, count in ((2, 40), (30, 40), (30, 80)):
        books = repo(edges)
        books.send(goal([], [connection("c0", ends=ENDS)]))
        apps = [app(n, connect="none") for n in range(count)]
        listed = [refused, *(link(n) for n in range(5, 5 + count))]
        calls, _, answer = work_of(books, demand(apps, listed))
        assert codes(answer) == {code}
        work.append(calls)
    few, many, twice = work
    assert many < 1.5 * few, "more nodes cost more, although none of them was worth a trial"
    assert twice < 2.5 * many, "the cost must grow with the demand and not faster"


def test_a_placement_on_a_thousand_nodes_costs_little_more_than_on_ten() -> None:
    made, work = demand([app(0, connect="none")]), []
    for books in (repo(10), repo(1_000)):
        assert books.decide(made).outcome == "booked"  # templates are compiled once
        work.append(work_of(books, made)[0])
    assert work[1] < 3 * work[0]


DENIED = {"overrides/no.yaml": override({"nodes": [f"e{n:03}" for n in range(10)]}, deny=True)}


def test_trials_are_bounded_by_number_and_the_answer_has_the_first_refusal_too() -> None:
    books = repo(12, DENIED)
    few = MOST_ATTEMPTS // 11  # each application is denied on ten nodes and booked on the eleventh
    assert books.decide(demand(app(n, connect="none") for n in range(few))).outcome == "booked"
    refusal = books.take(demand(app(n, connect="none") for n in range(few + 2)))
    assert codes(refusal) == {"denied", "too-large"}


def test_trials_are_bounded_by_what_they_book_together() -> None:
    made = demand([app(0, connect="none")], [link(n) for n in range(30)])
    assert repo(12, DENIED).decide(made).outcome == "booked"
    assert codes(repo(12, DENIED, demandItems=300).take(made)) == {"denied", "too-large"}


LARGE = {
    "placements": demand(app(n) for n in range(200)),
    "placements that nothing saves": demand(
        (app(n) for n in range(200)), (link(n, ("vehicle00", "vehicle01")) for n in range(800))
    ),
    "topics": demand([app(0, 980, node="edge")]),
    "topics without connections": demand([app(0, 1900, node="edge", connect="none")]),
    "topics of a connection": demand([], [link(0, topics=1900)]),
    "connections": demand([], [link(n) for n in range(980)]),
    "unknown nodes": demand([], [link(n, (f"vehicle{n}x", "edge")) for n in range(980)]),
    "unknown outputs": demand(
        [app(0, deliver=[{"output": f"object-fusion.o{n}", "node": "cloud"} for n in range(1800)])]
    ),
    "services": demand([app(0, node="edge", services={f"s{n}": "edge" for n in range(1900)})]),
    "parameters": demand([app(0, node="edge", parameters={f"p{n}": n for n in range(1900)})]),
    "requesters": demand([], [link(n) for n in range(40)], [f"r{n}" for n in range(40)]),
    "goals of the reference": goal(
        [application(f"a{n}", who=["attacker"]) for n in range(300)],
        [connection(f"c{n}", topics=[f"/t{n}"], broker="") for n in range(300)],
    ),
}


def test_drained_nodes_are_found_without_a_look_at_all_that_run_something() -> None:
    nodes = [{"id": "e000", "type": "edge", "cluster": "c-its", "drained": True}]
    file = {"apiVersion": "demandops/v1", "kind": "Nodes", "nodes": nodes}
    state, calls = repo(files={"inventory/nodes/edges.yaml": yaml.safe_dump(file)}).state, [0]
    used = HashTrieMap({f"e{n:03}": 1 for n in range(1_000)})
    state = replace(state, ledger=replace(state.ledger, applications_on=used))
    with counted(calls):
        assert state.nodes_to_drain() == ["e000"]
    assert calls[0] < 100


@pytest.mark.parametrize("name", LARGE)
def test_the_clock_is_looked_at_again_before_much_is_done(name: str) -> None:
    books, looks = repo(4, demandItems=2_000), 0

    def checkpoint() -> None:
        nonlocal looks
        looks += 1
        if looks > 3:
            raise OverBudget("too long")

    books.decide(demand([app(0)], [link(0)]))  # templates are compiled once
    _, longest, _ = work_of(books, LARGE[name])
    assert longest < 600_000, "about a tenth of a second"
    with pytest.raises(Refused) as refusal:
        decide(books.state, LARGE[name], books.now, books.files.get, checkpoint=checkpoint)
    assert "too-large" in codes(refusal.value)
    assert looks <= 5, "no other way may be tried"


def test_what_was_booked_is_released_however_long_it_takes() -> None:
    def checkpoint() -> None:
        raise OverBudget("too long")

    own, reference = demand([app(0)], [link(n) for n in range(20)]), perception()
    release = demand(operation="release")
    for made, end in ((own, release), (reference, reference | {"shutdown": True})):
        books = repo()
        books.send(made)
        ended = decide(books.state, end, books.now, books.files.get, checkpoint=checkpoint)
        assert ended.outcome == "released"


@pytest.mark.parametrize(
    "made",
    [
        demand([app(0, 19_000, node="edge")]),
        goal([], [connection(topics=[f"/t{n}" for n in range(19_000)])]),
        demand([], [link(n) for n in range(120)], [f"r{n}" for n in range(120)]),
        demand([app(0, node="edge", parameters={"x": "y" * 1_100_000})]),
        demand([app(0, node="edge", parameters={"x": [[]] * 600_000})]),
        {"kind": "Demand", "demand": "d" * 1_100_000},
    ],
    ids=["topics", "routes", "requesters of connections", "text", "lists", "id"],
)
def test_the_size_of_a_demand_is_checked_before_anything_is_planned(made: Goal) -> None:
    calls, _, answer = work_of(repo(), made)
    assert codes(answer) == {"too-large"}
    assert calls < 3_000_000


@pytest.mark.parametrize(
    "made",
    [
        lambda n: demand([app(0, n, node="edge")]),
        lambda n: demand([], [link(0, topics=n)]),
        lambda n: demand([app(i) for i in range(n // 4)]),
        lambda n: demand([], [link(i) for i in range(n // 4)]),
        lambda n: demand([], [link(i, (f"vehicle{i}x", "edge")) for i in range(n)]),
    ],
    ids=["topics", "routes", "placements", "connections", "unknown nodes"],
)
def test_the_work_grows_with_the_demand_and_not_faster(made: Callable[[int], Goal]) -> None:
    def work(count: int, *, held: bool) -> int:
        books = repo(4)
        if held:  # the same, once others hold it already
            books.take(made(count) | {"demand": "of others", "requesters": ["others"]})
        return work_of(books, made(count))[0]

    work(4, held=False)  # templates are compiled once
    for held in (False, True):
        once = work(400, held=held)
        assert work(800, held=held) < 2.5 * once


# ---- merged files with thousands of entries ----

MANY = plain_yaml.beside(__file__, "many-entries")


def files_of(kind: str, count: int) -> dict[str, str]:
    """Return the files with ``count`` entries of each form of a case."""
    files = dict[str, str]()
    for path, document in MANY[kind].items():
        if "{}" in path:
            files |= {
                numbered(path, number): override(*one.pop("select"), **one)
                for number, one in enumerate(numbered(document, n) for n in range(count))
            }
        else:
            entries = {
                field: [numbered(one[0], number) for number in range(count)]
                for field, one in document.items()
                if isinstance(one, list)
            }
            files[path] = yaml.safe_dump({"apiVersion": "demandops/v1"} | document | entries)
    return files


def numbered(entry: Any, number: int) -> Any:
    text = json.dumps(entry).replace(' "{}"', f" {number}")
    return json.loads(text.replace("{}", f"{number:04}"))


def work_of_loading(files: dict[str, str]) -> tuple[int, tuple[Fault, ...]]:
    calls, whole = [0], configuration(files)
    with counted(calls):
        try:
            load(whole)
        except InvalidInput as invalid:
            return calls[0], invalid.faults
    return calls[0], ()


@pytest.mark.parametrize("kind", MANY)
def test_the_work_to_load_files_grows_with_their_entries_and_not_faster(kind: str) -> None:
    work_of_loading({})  # what is read once for all
    none, _ = work_of_loading({})
    few, _ = work_of_loading(files_of(kind, 200))
    many, faults = work_of_loading(files_of(kind, 800))
    assert many - none < 6 * (few - none), "four times as many entries"
    assert len(faults) < 4 * 800
