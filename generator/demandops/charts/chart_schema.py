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

    ``own`` has the chart's properties that the library lacks or defines differently. ``values`` is
    the text of the chart's ``values.yaml``, and ``shared`` that of the library's.
    """
    prefix = f"exports.{EXPORT}."
    words = {
        path.removeprefix(prefix): description
        for path, description in descriptions(shared).items()
        if path.startswith(prefix)
    } | descriptions(values)
    properties = {**library["definitions"][EXPORT]["properties"], **own}
    definitions = {name: s for name, s in library["definitions"].items() if name != EXPORT}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": title,
        "type": "object",
        "additionalProperties": False,
        # `helm lint` lacks imported values, so the schema requires only the chart's own values.
        "required": sorted(own),
        "properties": {
            name: _described(copy.deepcopy(schema), name, words)
            for name, schema in sorted(properties.items())
        }
        # Helm adds these keys: one for the library's own values, and one for the global values.
        | {name: {"type": "object"} for name in (LIBRARY, "global")},
        "definitions": definitions,
    }


def _described(schema: dict[str, Any], path: str, words: Mapping[str, str]) -> dict[str, Any]:
    for name, inner in schema.get("properties", {}).items():
        schema["properties"][name] = _described(inner, f"{path}.{name}", words)
    return {**schema, "description": words[path]} if path in words else schema
