"""One mistake at any place of a valid configuration gives a fault at that place."""

from __future__ import annotations

from typing import Any

import pytest
from demandops import strict_yaml
from demandops.cli.repo.schema import SCHEMAS
from demandops.config.load import load
from demandops.errors import Fault, InvalidInput

from tests.kit import mutations, rich
from tests.kit.mutations import Form, Mutation, is_around, path

FORMS = {
    file.replace("<name>", "object-detection-fusion" if "appdefs" in file else "values"): Form(
        model.model_json_schema()
    )
    for model, file in SCHEMAS.values()
    if " " not in file
}
OVERRIDES = [f"overrides/{name}.yaml" for name in ("hold", "deny", "keep")]
DOCUMENTS = [
    *((rich.rich, file) for file in FORMS),
    *((rich.rich, file) for file in OVERRIDES),
    (rich.rich_with_api, "demandops.yaml"),
]
FREE = ("values", "values.podLabels", "parameters.rate.default")
"""Helm values and defaults of parameters are any JSON."""
FORM_OF_ELSEWHERE = {
    "gitops": ("flux", "argocd"),
}


def form(file: str) -> Form:
    return FORMS["overrides/values.yaml" if file.startswith("overrides/") else file]


class Loader:
    """Loads a configuration with one file given as plain data; each other text is parsed once."""

    def __init__(self, files: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
        self._files = files
        self._parsed: dict[str, Any] = {}
        self._parse = strict_yaml.load
        monkeypatch.setattr(strict_yaml, "load", self._load)

    def _load(self, text: str) -> Any:
        if text not in self._parsed:
            self._parsed[text] = self._parse(text)
        return self._parsed[text]

    def document(self, file: str) -> Any:
        return self._load(self._files[file])

    def faults(self, file: str, document: Any) -> tuple[Fault, ...]:
        self._parsed["mutated"] = document
        try:
            load(self._files | {file: "mutated"})
        except InvalidInput as invalid:
            return invalid.faults
        return ()


def problem(file: str, mutation: Mutation, faults: tuple[Fault, ...]) -> str:
    """Return what is wrong with the faults of a mutation, or an empty string."""
    place = path(mutation.place)
    here = [found for found in faults if found.file == file and is_around(found.field, place)]
    free = file.startswith("overrides/") and place.startswith("values.") or "default" in place
    must = form(file).forbids(mutation.document)
    must = must or (mutation.kind in mutations.CONTROL and not free)
    if must and not here:
        return f"no fault at {place}: {faults}"
    names = mutations.names_in(mutation)
    astray = [f for f in faults if f not in here and not mutations.quotes(f.message, names)]
    return f"a fault elsewhere: {astray}" if astray else ""


@pytest.mark.parametrize(("files", "file"), DOCUMENTS)
def test_a_mistake_anywhere_is_a_fault_at_its_place(
    files: Any, file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    loader = Loader(files(), monkeypatch)
    document = loader.document(file)
    assert loader.faults(file, document) == ()
    problems = [
        f"{path(mutation.place)} {mutation.kind}: {wrong}"
        for mutation in mutations.mutations(document)
        if (wrong := problem(file, mutation, loader.faults(file, mutation.document)))
    ]
    assert problems == []


def test_every_field_has_a_value_in_the_configuration() -> None:
    missing = {
        field
        for file, known in FORMS.items()
        for field in known.fields()
        - {
            used
            for files in (rich.rich(), rich.rich_with_api())
            for other, text in files.items()
            if other == file or (file.startswith("overrides/") and other.startswith("overrides/"))
            for used in known.fields_in(strict_yaml.load(text))
        }
    }
    assert missing == set()
