"""One mistake at any place of a valid configuration gives a fault at that place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput
from demandops.model.config.load import load

from tests.kit import forms
from tests.kit.forms import Form

DOMAINS = "policy/access-domains.yaml"
FORMS = {file: Form(model.model_json_schema()) for file, model in forms.CONFIG_MODELS.items()}
DOCUMENTS = [
    *((forms.rich, file) for file in FORMS),
    *((forms.rich, f"overrides/{name}.yaml") for name in ("hold", "deny", "keep", "refuse-new")),
    (forms.rich_with_api, "demandops.yaml"),
]
PROBES = ("startupProbe", "readinessProbe", "livenessProbe")
FREE = {
    *("OverrideFile.values", "Parameter.default"),
    *(f"{kind}ClientSettings.{probe}" for kind in ("", "Mqtt") for probe in PROBES),
}
FREE_PLACES = (
    *("values", "parameters.rate.default"),
    *(f"{kind}.{probe}" for kind in ("mqtt", "zenoh", "ros") for probe in PROBES),
)


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
        free = FREE_PLACES if file != "registry/charts.yaml" else ()
        problems.append(forms.problem(mutation, found, form, free=free, file=file))
    assert list(filter(None, problems)) == []


def test_every_field_of_every_file_is_tried() -> None:
    # these two belong to scopes that the rich configuration lacks; tests/unit/decide tries them
    tried = {"ServiceDefinition.nodes", "ServiceDefinition.place"}
    for files, file in DOCUMENTS:
        tried |= form_of(file).fields_in(strict_yaml.load(files()[file]))
    assert {field for form in FORMS.values() for field in form.fields()} - tried == set()


def test_only_the_listed_fields_may_have_any_value() -> None:
    assert {field for form in FORMS.values() for field in form.free()} == FREE
