"""The values of a chart, described by comments of ``values.yaml`` in the format of helm-docs.

A description starts with ``# --`` above its value and goes on in the comment lines that follow.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from demandops import strict_yaml

_KEY = re.compile(r"( *)([A-Za-z0-9_./-]+):(?: |$)")
_TYPES = {bool: "bool", int: "int", float: "float", str: "string", list: "list", dict: "object"}
_HEAD = "| Key | Type | Default | Description |\n|-----|------|---------|-------------|\n"


def descriptions(text: str) -> dict[str, str]:
    """Return the description of each value in the text of a ``values.yaml`` that has one.

    The keys are paths like ``image.tag``. A description is the comment ``# --`` before a value.
    """
    found: dict[str, str] = {}
    path: list[tuple[int, str]] = []
    said: list[str] = []
    for line in text.splitlines():
        comment = line.strip()
        if comment.startswith("# -- "):
            said = [comment.removeprefix("# -- ")]
        elif comment.startswith("# ") and said:
            said.append(comment.removeprefix("# "))
        elif key := _KEY.match(line):
            indent = len(key[1])
            path = [*(one for one in path if one[0] < indent), (indent, key[2])]
            if said:
                found[".".join(name for _, name in path)] = " ".join(said)
            said = []
        else:
            said = []
    return found


def table(text: str, root: str = "") -> str:
    """Return a Markdown table of the values below the path ``root`` in a ``values.yaml``.

    The table has each value with a description. A value without one is in the table if no keys are
    below it and no mapping around it has a description. Callers pass a ``root`` that exists, and
    values that are not null.
    """
    values: Any = strict_yaml.load(text)
    prefix = f"{root}." if root else ""
    told = {
        path.removeprefix(prefix): said
        for path, said in descriptions(text).items()
        if path.startswith(prefix)
    }
    for step in root.split(".") if root else ():
        values = values[step]
    rows = sorted(_rows(values, "", told, True), key=lambda row: row[0].lower())
    return _HEAD + "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _rows(
    values: Mapping[str, Any], prefix: str, told: Mapping[str, str], leaves: bool
) -> Iterator[tuple[str, str, str, str]]:
    for name, value in values.items():
        path = f"{prefix}{name}"
        nested = isinstance(value, dict) and bool(value)
        if path in told or (leaves and not nested):
            default = json.dumps(value, ensure_ascii=False, sort_keys=True, separators=(",", ":"))
            yield path, _TYPES[type(value)], f"`{default}`", told.get(path, "")
        if nested:
            yield from _rows(value, f"{path}.", told, leaves and path not in told)
