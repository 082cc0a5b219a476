"""A mistake at any place of a valid goal gives a fault at that place, and changes nothing."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from demandops.base.errors import Refused

from tests.kit import forms
from tests.kit.forms import Form
from tests.kit.goals import Goal
from tests.kit.memory import MemoryRepo

REFERENCE, OWN = (Form(model.model_json_schema()) for model in forms.GOAL_MODELS)
FREE = {"Application.parameters"}
FREE_PLACES = ("applications[0].parameters", "applications[1].parameters_json")
ELSEWHERE = {
    "connections[0].source_topics": "connections[0].target_topics",  # lengths then differ
    "shutdown": "apps[0].header.id",  # the shutdown finds no claim
    "connections[0].type": "connections[0].",  # another type has other rules
    "applications[0].parameters.rate": "parameters.rate",  # the merge finds it
    "applications[1].place": "applications[1].node",  # then both are missing
    "applications[1].parameters_json.": "applications[1].parameters.",
}
"""Maps a field to a second field, at which a mistake in the first field may be reported."""


@pytest.mark.parametrize(
    ("valid", "form"), [(forms.reference_goal, REFERENCE), (forms.own_goal, OWN)]
)
def test_a_mistake_anywhere_is_a_fault_at_its_place(valid: Callable[[], Goal], form: Form) -> None:
    repo = MemoryRepo(forms.rich())
    assert not isinstance(repo.copy().take(valid()), Refused)
    problems = []
    for mutation in forms.mutations(valid(), form.limits()):
        taken = repo.copy().take(mutation.document)
        place = forms.path(mutation.place)
        also = tuple(field for start, field in ELSEWHERE.items() if place.startswith(start))
        found = [
            fault
            for fault in (taken.faults if isinstance(taken, Refused) else ())
            if mutation.is_at(fault.field) or not fault.field.startswith(also)
        ]
        problems.append(forms.problem(mutation, found, form, free=FREE_PLACES))
    assert list(filter(None, problems)) == []


def test_every_field_of_a_goal_is_tried() -> None:
    assert REFERENCE.fields() == REFERENCE.fields_in(forms.reference_goal())
    assert OWN.fields() == OWN.fields_in(forms.own_goal())


def test_only_the_listed_fields_may_have_any_value() -> None:
    assert REFERENCE.free() | OWN.free() == FREE
