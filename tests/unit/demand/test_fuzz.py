"""Any value sent as a goal gives a decision, or a refusal with faults, and no other error."""

from __future__ import annotations

from typing import Any
from unicodedata import category

from demandops.base.errors import Fault, Refused
from demandops.decide.decision import Decision, decide
from demandops.model.demand import goals
from hypothesis import example, given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.goals import APP, CLOUD
from tests.kit.memory import NOW, MemoryRepo

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


def _nested(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.lists(inner, max_size=4) | st.dictionaries(KEY | SCALAR, inner, max_size=5)


ANYTHING = st.recursive(SCALAR, _nested, max_leaves=25)


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


def test_a_name_with_half_a_character_is_refused_wherever_it_stands() -> None:
    put = {"kind": "Demand", "demand": "d", "applications": [{"inputs": {"\ud800": {}}}]}
    found = outcome(put)
    assert isinstance(found, tuple)
    assert "applications[0].inputs: the key '\\ud800' is not text; write whole characters" in [
        str(one) for one in found
    ]
