"""The published schemas describe every property with an example, and say patterns in words."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import jsonschema_rs
import pytest
from demandops.base.naming import PATTERN_WORDS
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


def patterns_of(part: Any) -> set[str]:
    if isinstance(part, list):
        return {found for each in part for found in patterns_of(each)}
    if not isinstance(part, dict):
        return set()
    found = {part["pattern"]} if isinstance(part.get("pattern"), str) else set[str]()
    found |= {*part.get("patternProperties", {})}
    return found | {each for value in part.values() for each in patterns_of(value)}


def test_every_pattern_of_a_file_is_said_in_words() -> None:
    used = {
        one
        for model, _ in schema.SCHEMAS.values()
        for one in patterns_of(model.model_json_schema())
    }
    assert used == PATTERN_WORDS.keys()
