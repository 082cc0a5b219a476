"""One mistake at any place of a valid configuration gives a fault at that place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput
from demandops.model.config.load import load

from tests.kit import mutations, rich
from tests.kit.mutations import Form

DOMAINS = "policy/access-domains.yaml"
FORMS = {file: Form(model.model_json_schema()) for file, model in rich.CONFIG_MODELS.items()}
DOCUMENTS = [
    *((rich.rich, file) for file in FORMS),
    *((rich.rich, f"overrides/{name}.yaml") for name in ("hold", "deny", "keep")),
    (rich.rich_with_api, "demandops.yaml"),
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


class Loader:
    """Loads a configuration with one file given as parsed data. Parses other files only once."""

    def __init__(self, files: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
        self._files = files
        self._parsed: dict[str, Any] = {}
        self._parse = strict_yaml.load
        monkeypatch.setattr(strict_yaml, "load", self._load)

    def _load(self, text: str, file: str = "") -> Any:
        if text not in self._parsed:
            self._parsed[text] = self._parse(text, file)
        return self._parsed[text]

    def document(self, file: str) -> Any:
        return self._load(self._files[file])

    def faults(self, file: str, document: Any) -> list[Fault]:
        self._parsed["mutated"] = document
        try:
            load(self._files | {file: "mutated"})
        except InvalidInput as invalid:
            return list(invalid.faults)
        return []


@pytest.mark.parametrize(("files", "file"), DOCUMENTS)
def test_a_mistake_anywhere_is_a_fault_at_its_place(
    files: Callable[[], dict[str, str]], file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    loader = Loader(files(), monkeypatch)
    document = loader.document(file)
    assert loader.faults(file, document) == []
    problems = []
    for mutation in mutations.mutations(document, form_of(file).limits()):
        found = loader.faults(file, mutation.document)
        if file == DOMAINS:  # an invalid domain has no nodes, so overrides have faults too
            found = [one for one in found if one.file == file or "access domain" not in one.message]
        free = FREE_PLACES if file != "registry/charts.yaml" else ()
        problems.append(mutations.problem(mutation, found, form_of(file), free=free, file=file))
    assert list(filter(None, problems)) == []


def test_every_field_of_every_file_is_tried() -> None:
    # these two belong to scopes that the rich configuration lacks; tests/unit/decide tries them
    tried = {"ServiceDefinition.nodes", "ServiceDefinition.place"}
    for files, file in DOCUMENTS:
        tried |= form_of(file).fields_in(strict_yaml.load(files()[file]))
    assert {field for form in FORMS.values() for field in form.fields()} - tried == set()


def test_only_the_listed_fields_may_have_any_value() -> None:
    assert {field for form in FORMS.values() for field in form.free()} == FREE
