"""The values of a chart, described by comments of ``values.yaml`` in the format of helm-docs.

A description starts with ``# --`` above its value and goes on in the comment lines that follow.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from demandops.base import strict_yaml

_KEY = re.compile(r"( *)([A-Za-z0-9_./-]+):(?: |$)")
_TYPES = {bool: "bool", int: "int", float: "float", str: "string", list: "list", dict: "object"}
_HEAD = "| Key | Type | Default | Description |\n|-----|------|---------|-------------|\n"


def descriptions(text: str) -> dict[str, str]:
    """Return the descriptions in a ``values.yaml``, by paths like ``image.tag``."""
    described: dict[str, str] = {}
    path: list[tuple[int, str]] = []
    words: list[str] = []
    for line in text.splitlines():
        comment = line.strip()
        if comment.startswith("# -- "):
            words = [comment.removeprefix("# -- ")]
        elif comment.startswith("# ") and words:
            words.append(comment.removeprefix("# "))
        elif key := _KEY.match(line):
            indent = len(key[1])
            path = [*(step for step in path if step[0] < indent), (indent, key[2])]
            if words:
                described[".".join(name for _, name in path)] = " ".join(words)
            words = []
        else:
            words = []
    return described


def table(text: str, root: str = "") -> str:
    """Return a Markdown table of the values below the path ``root`` in a ``values.yaml``.

    Callers pass a ``root`` that exists, and values that are not null.
    """
    values: Any = strict_yaml.load(text)
    prefix = f"{root}." if root else ""
    words = {
        path.removeprefix(prefix): description
        for path, description in descriptions(text).items()
        if path.startswith(prefix)
    }
    for step in root.split(".") if root else ():
        values = values[step]
    rows = sorted(_rows(values, "", words, True), key=lambda row: row[0].lower())
    return _HEAD + "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _rows(
    values: Mapping[str, Any], prefix: str, words: Mapping[str, str], leaves: bool
) -> Iterator[tuple[str, str, str, str]]:
    for name, value in values.items():
        path = f"{prefix}{name}"
        nested = isinstance(value, dict) and bool(value)
        if path in words or (leaves and not nested):
            default = json.dumps(value, ensure_ascii=False, sort_keys=True, separators=(",", ":"))
            yield path, _TYPES[type(value)], f"`{default}`", words.get(path, "")
        if nested:
            # below a mapping with a description, only values with one of their own are listed
            yield from _rows(value, f"{path}.", words, leaves and path not in words)


# ---- the ``values.schema.json`` of a chart, for its own values and the values that it imports ----
#
# Neither Helm nor the generator follows a reference to another schema file. So this module copies
# the library's schema into the chart's schema.

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
