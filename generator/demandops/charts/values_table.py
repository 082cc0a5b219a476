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
