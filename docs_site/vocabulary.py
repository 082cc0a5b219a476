"""Makes the page of the JSON output from docs/json.schema.yaml."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml
from demandops.cli.main import COMMANDS

SCHEMA = Path(__file__).parents[1] / "docs" / "json.schema.yaml"


def page() -> str:
    """Return the page as Markdown: the keys of each command, then those of each thing."""
    parts: dict[str, Any] = yaml.safe_load(SCHEMA.read_text())["$defs"]
    commands = {name: part for name, part in parts.items() if name.partition("-")[0] in COMMANDS}
    text = [
        "# JSON, key by key",
        "Generated from [json.schema.yaml](../json.schema.yaml), which a test holds every command "
        "to. What the keys mean: [json.md](../json.md).",
    ]
    for title, group in (("By command", commands), ("Things", parts.keys() - commands.keys())):
        text.append(f"## {title}")
        for name in sorted(group):
            text += [f"### {name}", _told(parts[name])]
    return "\n\n".join(filter(None, text)) + "\n"


def _told(part: dict[str, Any]) -> str:
    """Return a table of an object's keys, or the type of anything else."""
    inner = part.get("items", part) if part.get("type") == "array" else part
    keys = {name: {} for name in inner.get("required", ())} | inner.get("properties", {})
    lead = f"{_type(part)}." if inner is not part or not keys else ""
    rows = []
    for name, key in keys.items():
        absent = "" if name in inner.get("required", ()) else "may be absent"
        rows.append(f"| `{name}` | {_type(key)} | {absent} |")
    table = "\n".join(["| key | type | |", "| --- | --- | --- |", *rows]) if rows else ""
    return "\n\n".join(filter(None, (lead, table)))


def _type(part: dict[str, Any]) -> str:
    if reference := part.get("$ref"):
        name = str(reference).rpartition("/")[2]
        return f"[{name}](#{name})"
    if "enum" in part:
        return " or ".join(f"`{json.dumps(value)}`" for value in part["enum"])
    if "anyOf" in part:
        return " or ".join(map(_type, part["anyOf"]))
    kinds = part.get("type", "any")
    return " or ".join(
        f"list of {_type(part['items'])}"
        if kind == "array" and "items" in part
        else f"map of {_type(part['additionalProperties'])}"
        if kind == "object" and isinstance(part.get("additionalProperties"), dict)
        else str(kind)
        for kind in ([kinds] if isinstance(kinds, str) else kinds)
    )
