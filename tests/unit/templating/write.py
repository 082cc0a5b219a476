"""Write the generated files of the charts: their schemas, and the tables in their READMEs.

Run ``python -m tests.unit.templating.write`` and review the diff.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from demandops.templating import charts

ROOT = Path(__file__).parents[3]
LIBRARY = ROOT / "appdefs" / "charts" / "ros-service"
CHARTS = [
    path.parent
    for top in ("appdefs", "examples")
    for path in sorted((ROOT / top).rglob("Chart.yaml"))
    if path.parent != LIBRARY and LIBRARY.name in path.read_text()  # those made with the library
]


def schema(chart: Path) -> str:
    """Return the schema that a chart must have: its own properties and those of the library."""
    known = json.loads((chart / "values.schema.json").read_text())
    library = json.loads((LIBRARY / "values.schema.json").read_text())
    library_properties = library["definitions"][charts.EXPORT]["properties"]
    of_library, of_chart = (
        {name: without_descriptions(inner) for name, inner in properties.items()}
        for properties in (library_properties, known["properties"])
    )
    own = {
        name: inner
        for name, inner in of_chart.items()
        if name not in (charts.LIBRARY, "global") and inner != of_library.get(name)
    }
    values, shared = ((each / "values.yaml").read_text() for each in (chart, LIBRARY))
    data = charts.composed(known["title"], own, values, library, shared)
    return json.dumps(data, indent=2, ensure_ascii=False) + "\n"


def without_descriptions(schema: dict[str, Any]) -> dict[str, Any]:
    plain = {name: value for name, value in schema.items() if name != "description"}
    if "properties" in schema:
        properties = schema["properties"].items()
        plain["properties"] = {name: without_descriptions(inner) for name, inner in properties}
    return plain


def readme(chart: Path) -> str:
    """Return the text of a chart's README, with its table made anew from ``values.yaml``."""
    text = (chart / "README.md").read_text()
    values = (chart / "values.yaml").read_text()
    root = f"exports.{charts.EXPORT}" if chart == LIBRARY else ""
    metadata = yaml.safe_load((chart / "Chart.yaml").read_text())
    assert text.startswith(f"# {metadata['name']}\n\n{metadata['description']}\n")
    return re.sub(r"(?s)\| Key \| Type.*?\n(?=\n|\Z)", lambda _: table(values, root), text)


_TYPES = {bool: "bool", int: "int", float: "float", str: "string", list: "list", dict: "object"}
_HEAD = "| Key | Type | Default | Description |\n|-----|------|---------|-------------|\n"


def table(text: str, root: str = "") -> str:
    """Return a Markdown table of the values below the path ``root`` in a ``values.yaml``."""
    values: Any = yaml.safe_load(text)
    prefix = f"{root}." if root else ""
    words = {
        path.removeprefix(prefix): description
        for path, description in charts.descriptions(text).items()
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


def main() -> None:
    for chart in CHARTS:
        (chart / "values.schema.json").write_text(schema(chart))
    for chart in (LIBRARY, *CHARTS):
        (chart / "README.md").write_text(readme(chart))


if __name__ == "__main__":
    main()
