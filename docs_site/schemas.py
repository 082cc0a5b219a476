"""Makes the page of file formats from the pydantic models that read the files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

from demandops.cli.authoring import schema as command


def page() -> str:
    """Return the page as Markdown.

    It has a table of fields for each file, and for each part of a file.
    """
    parts = [
        "# File formats",
        "Generated from the models that read the files. A field that is not listed is refused. "
        "`demandops schema NAME` prints the JSON Schema, and each section here links it; "
        "editors complete and check files with it.",
    ]
    for name in sorted(command.SCHEMAS):
        schema = json.loads(command.text(name))
        link = f"JSON Schema: [{name}.json](../schemas/{name}.json)"
        parts += [f"## {name}", f"{_place(name)}. {link}", _table(schema, name)]
        for part, body in schema.get("$defs", {}).items():
            if body.get("properties"):
                parts += [f"### {name}: {part}", _described(body), _table(body, name)]
    return "\n\n".join(filter(None, parts)) + "\n"


def json_files() -> dict[str, str]:
    """Return the JSON Schemas, by their paths on the site."""
    return {f"schemas/{name}.json": command.text(name) for name in command.SCHEMAS}


def _place(name: str) -> str:
    file = command.SCHEMAS[name][1]
    return f"File: {file}" if "`" in file else f"File: `{file}`"


def _described(schema: dict[str, Any]) -> str:
    """Return the first paragraph of a model's description, without the marks of Sphinx."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", str(schema.get("description", "")))
    return " ".join(text.replace("``", "`").split("\n\n")[0].split())


def _table(schema: dict[str, Any], file: str) -> str:
    needed = schema.get("required", ())
    rows = []
    for name, field in schema.get("properties", {}).items():
        default = "required" if name in needed else _default(field)
        types, example = " or ".join(_types(field, file)), _json(field["examples"][0])
        rows.append(f"| `{name}` | {field['description']} | {types} | {default} | {example} |")
    head = "| field | meaning | type | default | example |"
    return "\n".join([head, "| --- | --- | --- | --- | --- |", *rows])


def _json(value: object) -> str:
    return f"`{json.dumps(value, ensure_ascii=False)}`"


def _default(field: dict[str, Any]) -> str:
    default = field.get("default")
    if default is None or "$ref" in field:  # the part's own table shows the defaults
        return ""
    return _json(default)


def _types(field: dict[str, Any], file: str) -> Iterator[str]:
    """Yield the types that a field may have, with a link to each part."""
    if reference := field.get("$ref"):
        part = str(reference).rpartition("/")[2]
        yield f"[{part}](#{_anchor(f'{file}: {part}')})"
    elif "anyOf" in field or "oneOf" in field:
        for one in field.get("anyOf") or field["oneOf"]:
            if one.get("type") != "null":
                yield from _types(one, file)
    elif "enum" in field or "const" in field:
        yield from (f"`{json.dumps(one)}`" for one in field.get("enum", [field.get("const")]))
    elif field.get("type") == "array":
        yield f"list of {' or '.join(_types(field.get('items', {}), file))}"
    elif field.get("type") == "object":
        inner = [*field.get("patternProperties", {}).values(), field.get("additionalProperties")]
        values = [one for one in inner if isinstance(one, dict)]
        yield f"map of {' or '.join(_types(values[0], file))}" if values else "map"
    else:
        yield str(field.get("type", "any"))


def _anchor(heading: str) -> str:
    """Return the id that markdown's `toc` gives a heading."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower())
