"""A description and an example of each property of a JSON Schema, for editors and the docs."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from demandops import strict_yaml
from demandops.settings import API_VERSION, data_folder

_INHERITS = "inherits"
_COMMON = {
    "apiVersion": ["Version of the format", API_VERSION],
    "kind": ["Type of the file's content"],
}


def describe(schema: dict[str, Any], root: str) -> None:
    """Add descriptions and examples to the properties of a schema and its definitions.

    They come from ``templates/schemas/properties.yaml``. Other properties stay as they are.
    ``root`` is the name of the model whose JSON Schema is changed.
    """
    properties = _properties()
    for model, part in {root: schema, **schema.get("$defs", {})}.items():
        for name, field in part.get("properties", {}).items():
            # for the model in this schema, else for the model, else for the one it inherits from
            places = (f"{root}/{model}", model, properties[_INHERITS].get(model, ""))
            models = (*(properties.get(place) or {} for place in places), _COMMON)
            entry = next((each[name] for each in models if name in each), None)
            if entry:
                description, *example = entry
                field["description"] = description
                field["examples"] = example or _fixed(field)


def _fixed(field: dict[str, Any]) -> list[Any]:
    """Return a list with one example if only certain values are valid; otherwise an empty list."""
    for part in (field, *field.get("anyOf", ())):
        if "const" in part:
            return [part["const"]]
        if "enum" in part:
            return [part["enum"][-1]]
        if part.get("type") == "boolean":
            return [True]
    return []


@lru_cache(maxsize=1)
def _properties() -> dict[str, Any]:
    file = data_folder("templates") / "schemas" / "properties.yaml"
    properties: dict[str, Any] = strict_yaml.load(file.read_text(encoding="utf-8"), file.name)
    return properties
