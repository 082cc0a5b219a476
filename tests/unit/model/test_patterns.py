"""For each pattern of a field, ``PATTERN_WORDS`` says in words which values match."""

from __future__ import annotations

from typing import Any

from demandops.base.naming import PATTERN_WORDS
from demandops.cli.authoring.schema import SCHEMAS


def patterns_of(schema: Any) -> set[str]:
    if isinstance(schema, list):
        return {found for each in schema for found in patterns_of(each)}
    if not isinstance(schema, dict):
        return set()
    found = {schema["pattern"]} if isinstance(schema.get("pattern"), str) else set[str]()
    found |= {*schema.get("patternProperties", {})}
    return found | {each for value in schema.values() for each in patterns_of(value)}


def test_every_pattern_of_a_file_is_said_in_words() -> None:
    used = {one for model, _ in SCHEMAS.values() for one in patterns_of(model.model_json_schema())}
    assert used == PATTERN_WORDS.keys()
