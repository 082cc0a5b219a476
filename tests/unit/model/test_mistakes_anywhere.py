"""One mistake at any place of a valid configuration or goal gives a fault at that place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, Refused
from demandops.model.config.load import load

from tests.kit import forms, plain_yaml
from tests.kit.forms import Form
from tests.kit.goals import Goal
from tests.kit.memory import MemoryRepo

DOMAINS = "policy/access-domains.yaml"
FORMS = {file: Form(model.model_json_schema()) for file, model in forms.CONFIG_MODELS.items()}
DOCUMENTS = [
    *((forms.rich, file) for file in FORMS),
    *((forms.rich, f"overrides/{name}.yaml") for name in ("hold", "deny", "keep", "refuse-new")),
    (forms.rich_with_api, "demandops.yaml"),
]
GOALS = {
    goal: Form(model.model_json_schema())
    for goal, model in zip((forms.reference_goal, forms.own_goal), forms.GOAL_MODELS, strict=True)
}
TABLES = plain_yaml.beside(__file__)


def form_of(file: str) -> Form:
    return FORMS["overrides/values.yaml" if file.startswith("overrides/") else file]


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Parse each text only once; return what is known of texts, to which a test may add."""
    known: dict[str, Any] = {}
    parse = strict_yaml.load

    def load_once(text: str, file: str = "") -> Any:
        if text not in known:
            known[text] = parse(text, file)
        return known[text]

    monkeypatch.setattr(strict_yaml, "load", load_once)
    return known


def faults(files: dict[str, str]) -> list[Fault]:
    try:
        load(files)
    except InvalidInput as invalid:
        return list(invalid.faults)
    return []


@pytest.mark.parametrize(("files", "file"), DOCUMENTS)
def test_a_mistake_anywhere_is_a_fault_at_its_place(
    files: Callable[[], dict[str, str]], file: str, parsed: dict[str, Any]
) -> None:
    whole, form = files(), form_of(file)
    assert faults(whole) == []
    problems = []
    for mutation in forms.mutations(parsed[whole[file]], form.limits()):
        parsed["mutated"] = mutation.document
        found = faults(whole | {file: "mutated"})
        if file == DOMAINS:  # an invalid domain has no nodes, so overrides have faults too
            found = [one for one in found if one.file == file or "access domain" not in one.message]
        free = TABLES["free"] if file != "registry/charts.yaml" else ()
        problems.append(forms.problem(mutation, found, form, free=free, file=file))
    assert list(filter(None, problems)) == []


@pytest.mark.parametrize(("valid", "form"), [*GOALS.items()])
def test_a_mistake_anywhere_in_a_goal_is_a_fault_at_its_place(
    valid: Callable[[], Goal], form: Form
) -> None:
    repo = MemoryRepo(forms.rich())
    assert not isinstance(repo.copy().take(valid()), Refused)
    problems = []
    for mutation in forms.mutations(valid(), form.limits()):
        taken = repo.copy().take(mutation.document)
        place = forms.path(mutation.place)
        also = tuple(
            field for start, field in TABLES["elsewhere"].items() if place.startswith(start)
        )
        found = [
            fault
            for fault in (taken.faults if isinstance(taken, Refused) else ())
            if mutation.is_at(fault.field) or not fault.field.startswith(also)
        ]
        problems.append(forms.problem(mutation, found, form, free=TABLES["free in goals"]))
    assert list(filter(None, problems)) == []


def test_every_field_of_every_file_and_goal_is_tried() -> None:
    # these two belong to scopes that the rich configuration lacks; tests/unit/decide tries them
    tried = {"ServiceDefinition.nodes", "ServiceDefinition.place"}
    for files, file in DOCUMENTS:
        tried |= form_of(file).fields_in(strict_yaml.load(files()[file]))
    assert {field for form in FORMS.values() for field in form.fields()} - tried == set()
    for goal, form in GOALS.items():
        assert form.fields() == form.fields_in(goal())


def test_only_the_listed_fields_may_have_any_value() -> None:
    every = (*FORMS.values(), *GOALS.values())
    assert {field for form in every for field in form.free()} == {*TABLES["free fields"]}
