"""The ``values.schema.json`` of a chart, for its own values and the values that it imports.

Neither Helm nor the generator follows a reference to another schema file. So this module copies the
library's schema into the chart's schema.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from demandops.charts.values_table import descriptions

LIBRARY = "ros-service"
EXPORT = "service"


def composed(
    title: str, own: Mapping[str, Any], values: str, library: Mapping[str, Any], shared: str
) -> dict[str, Any]:
    """Return the schema of a chart, including the library's values and all descriptions.

    Args:
        title: the schema's title.
        own: name → property, for the chart's properties that the library lacks or defines
            differently. The schema requires all of them.
        values: the text of the chart's ``values.yaml``, with the descriptions of the values.
        library: the schema of the library.
        shared: the text of the library's ``values.yaml``.
    """
    prefix = f"exports.{EXPORT}."
    told = {
        path.removeprefix(prefix): said
        for path, said in descriptions(shared).items()
        if path.startswith(prefix)
    } | descriptions(values)
    properties = {**library["definitions"][EXPORT]["properties"], **own}
    definitions = {name: one for name, one in library["definitions"].items() if name != EXPORT}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": title,
        "type": "object",
        "additionalProperties": False,
        # `helm lint` lacks imported values, so the schema requires only the chart's own values.
        "required": sorted(own),
        "properties": {
            name: _described(copy.deepcopy(one), name, told)
            for name, one in sorted(properties.items())
        }
        # Helm adds these keys: one for the library's own values, and one for the global values.
        | {name: {"type": "object"} for name in (LIBRARY, "global")},
        "definitions": definitions,
    }


def own_properties(schema: Mapping[str, Any], library: Mapping[str, Any]) -> dict[str, Any]:
    """Return those properties of a chart's schema that the library lacks or defines differently.

    The result maps names to properties. Descriptions are ignored and left out.
    """
    shared = {
        name: _plain(copy.deepcopy(one))
        for name, one in library["definitions"][EXPORT]["properties"].items()
    }
    plain = {name: _plain(copy.deepcopy(one)) for name, one in schema["properties"].items()}
    return {
        name: one
        for name, one in plain.items()
        if name not in (LIBRARY, "global") and one != shared.get(name)
    }


def _described(schema: dict[str, Any], path: str, told: Mapping[str, str]) -> dict[str, Any]:
    for name, one in schema.get("properties", {}).items():
        schema["properties"][name] = _described(one, f"{path}.{name}", told)
    return {**schema, "description": told[path]} if path in told else schema


def _plain(schema: dict[str, Any]) -> dict[str, Any]:
    for name, one in schema.get("properties", {}).items():
        schema["properties"][name] = _plain(one)
    schema.pop("description", None)
    return schema
