"""Demands that are refused.

``tests/unit/messages`` has the messages for the tables of ``test_refused.yaml``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unicodedata import category

import pytest
import yaml
from demandops.base.errors import MOST_FAULTS, Fault, Refused, suggestion
from demandops.base.naming import topic_problem
from demandops.decide.decision import Decision, decide
from demandops.model.demand import goals
from hypothesis import example, given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.goals import APP, CLOUD, Goal, application, connection, goal, put
from tests.kit.memory import NOW, MemoryRepo
from tests.unit.decide.test_budget import counted


def _made(make: Callable[..., Any], written: Any) -> Any:
    if not isinstance(written, dict):
        return written
    fields = {name: value for name, value in written.items() if name != "also"}
    made = make(**fields) | written.get("also", {})
    return {name: value for name, value in made.items() if value is not None}


def demand_of(written: Any) -> Any:
    """Return the demand that an entry of ``test_refused.yaml`` describes."""
    if not isinstance(written, dict) or "kind" in written:
        return written
    apps = [_made(application, one) for one in written.get("apps", ())]
    connections = [_made(connection, one) for one in written.get("connections", ())]
    return _made(goal, written | {"apps": apps, "connections": connections})


_TEXT = Path(__file__).with_suffix(".yaml").read_text()
TABLES = yaml.safe_load(re.sub(r"([\w[\]])\*(\d+)", lambda x: x[1] * int(x[2]), _TEXT))
REFUSED, CONTRADICTING, WRONG = (
    {name: demand_of(written) for name, written in TABLES[table].items()}
    for table in ("refused", "contradicting", "form")
)
WRONG["keys that are no text"][1, 2] = "x"


@pytest.mark.parametrize("topic", TABLES["topics"])
def test_a_topic_name_that_ros_forbids_is_refused(topic: str) -> None:
    """``test_mistakes_anywhere`` tries each place of a topic."""
    assert "is not a topic name that ROS 2 allows" in topic_problem(topic)


def faults(books: MemoryRepo, asked: Goal) -> tuple[Fault, ...]:
    refused = books.take(asked)
    assert isinstance(refused, Refused)
    return refused.faults


@pytest.mark.parametrize("key", ["k{}".format, int])
def test_a_demand_with_too_many_fields_is_refused_at_once(key: Callable[[int], Any]) -> None:
    fields = {key(number): 0 for number in range(2_000)}
    found = faults(MemoryRepo(), put("d") | {"applications": [fields] * 80})
    assert [one.code for one in found] == ["too-large"]


def test_of_many_faults_of_form_the_first_are_told() -> None:
    fields = {f"k{number}": 0 for number in range(2_000)}
    found = faults(MemoryRepo(), put("d") | {"applications": [fields] * 2})
    assert len(found) == MOST_FAULTS
    assert "applications[0].k0" in {one.field for one in found}


def test_of_many_faults_the_first_are_told_and_the_others_counted() -> None:
    found = MemoryRepo().faults(goal([], [connection(topics=["/a b"] * 150)]))
    assert len(found) == 101
    assert found[-1] == ": has 200 more faults"
    (found, *_) = MemoryRepo().faults(goal([]) | {"x" * 10**6: 1})
    assert len(found) < 10_000


def test_similar_names_are_found_soon_however_many_words_are_unknown() -> None:
    names, calls = [f"vehicle-{number:04}" for number in range(1000)], [0]
    with counted(calls):
        for number in range(0, 1000, 20):
            suggestion(f"vehicel-{number:04}", names)
    assert calls[0] < 50 * 10_000, "a word must not be compared with each name"
    for word in ("vehicle-0123x", "xehicle-0123", "vehicle-123"):
        assert suggestion(word, names) == "; did you mean 'vehicle-0123'?"


# ---- any value sent as a goal gives a decision, or a refusal with faults, and no other error ----


TEXT = st.text(max_size=12) | st.sampled_from(
    ["", "edge", "vehicle00", APP, CLOUD[0], "/a", "..", "~", "\\", "\ud800", "a" * 1100, "{{ x }}"]
)
SCALAR: st.SearchStrategy[Any] = (
    st.none() | st.booleans() | st.integers() | st.floats() | TEXT | st.binary(max_size=3)
)
UNSEEN = {"Cc", "Cs", "Zl", "Zp"}
"""Unicode categories of characters that move a terminal's cursor or may break a line."""

_GOAL_MODELS = [
    getattr(goals, f"Wire{part}")
    for part in ("Goal", "Application", "Body", "Connection", "Header", "Topic")
]
KEY = st.sampled_from([name for model in _GOAL_MODELS for name in model.model_fields]) | TEXT
ANYTHING = st.recursive(
    SCALAR,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEY | SCALAR, inner, max_size=5),
    max_leaves=25,
)


def outcome(goal: object) -> Decision | tuple[Fault, ...]:
    books = MemoryRepo()
    before = repr(goal)
    try:
        return decide(books.state, goal, NOW, books.files.get)
    except Refused as refused:
        return refused.faults
    finally:
        assert repr(goal) == before, "the decision changed the goal"


def assert_told(faults: tuple[Fault, ...]) -> None:
    assert faults, "a refusal must give a reason"
    assert len(set(faults)) == len(faults), "no reason may be given twice"
    for found in faults:
        assert found.message
        assert found.code
        assert not UNSEEN & set(map(category, str(found))), repr(found)
        assert not found.field.startswith("applications["), "the action calls this field apps"


@examples(70)
@example({"\ud800": 1})
@example({"apps": [{"\ud800": 1}]})
@given(ANYTHING)
def test_whatever_comes_is_refused_with_a_reason(data: Any) -> None:
    found = outcome(data)
    assert isinstance(found, tuple), "no value made up here can be a demand"
    assert_told(found)
