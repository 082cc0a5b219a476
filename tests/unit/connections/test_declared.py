"""Clients get only parameters that their programs declare, as ``declared.yaml`` lists them.

The tests' repo in memory takes no configuration with a field that its schema lacks, so the schemas
are compared.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from demandops.base.settings import data_folder
from demandops.connections import connection_types

from tests.kit import plain_yaml

DECLARED = plain_yaml.beside(__file__, "declared")
TYPES = {"string": "str", "integer": "int", "boolean": "bool", "number": "float"}


def leaves(schema: Any, definitions: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield (path, name of the Python type) for each value that a schema allows."""
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    if schema.get("type") == "array":
        items = schema["items"]
        for item in items if isinstance(items, list) else [items]:
            yield from leaves(item, definitions, f"{path}[]")
    elif schema.get("type") == "object":
        assert schema["additionalProperties"] is False, path
        patterns = [("{}", part) for part in schema.get("patternProperties", {}).values()]
        for name, part in (*schema.get("properties", {}).items(), *patterns):
            yield from leaves(part, definitions, f"{path}.{name}" if path else name)
    else:
        values = schema.get("enum", [schema.get("const")])
        yield path, TYPES[schema["type"]] if "type" in schema else type(values[0]).__name__


@pytest.mark.parametrize("program", DECLARED, ids=lambda one: f"{one['program']} {one['version']}")
def test_a_program_declares_all_that_its_clients_are_told(program: dict[str, Any]) -> None:
    file = data_folder("templates") / "connections" / program["type"] / "schema.json"
    schema = json.loads(file.read_text())
    prefix = "/**/*.ros__parameters."  # for all nodes of a ROS program
    told = {
        (path.removeprefix(prefix), name) for path, name in leaves(schema, schema["definitions"])
    }
    assert len(told) > 5
    assert told - {*program["reads"].items()} == set()


def test_there_is_a_program_for_each_connection_type() -> None:
    words = {known.word for known in connection_types.CONNECTION_TYPES}
    assert {program["type"] for program in DECLARED} == words
