"""Every property of the published schemas has a description and a valid example."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import jsonschema_rs
import pytest
from demandops.cli.authoring import schema

FILE = "templates/schemas/properties.yaml"


def properties(name: str) -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Yield each property of a published schema: its name, its schema, and the whole document."""
    document = json.loads(schema.text(name))
    root = schema.SCHEMAS[name][0].__name__
    for model, part in {root: document, **document.get("$defs", {})}.items():
        for field, one in part.get("properties", {}).items():
            yield f"{model}.{field}", one, document


@pytest.mark.parametrize("name", schema.SCHEMAS)
def test_every_property_has_a_description_and_a_valid_example(name: str) -> None:
    bare = [
        field
        for field, one, _ in properties(name)
        if not one.get("description") or not one.get("examples")
    ]
    assert bare == [], f"add them to {FILE}"
    for field, one, document in properties(name):
        own = {"$schema": document["$schema"], "$defs": document.get("$defs", {}), **one}
        validator = jsonschema_rs.validator_for(own)
        for example in one["examples"]:
            faults = [error.message for error in validator.iter_errors(example)]
            assert faults == [], (field, example)


def test_nothing_else_is_described_and_each_entry_has_at_most_an_example() -> None:
    known = {field for name in schema.SCHEMAS for field, *_ in properties(name)}
    listed = {
        f"{model.rpartition('/')[2]}.{field}": said
        for model, fields in schema._properties().items()
        if model != "inherits"
        for field, said in fields.items()
    }
    assert listed.keys() - known == set()
    odd = [field for field, said in listed.items() if len(said) > 2 or not isinstance(said[0], str)]
    assert odd == []
