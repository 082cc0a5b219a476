"""Checks, without Helm, of the charts and their library.

These tests compare schemas, default values and READMEs with each other. tests/golden has the values
that the generator writes. tests/e2e renders the charts with the real Helm.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
from demandops.base.errors import InvalidInput
from demandops.model.config.load import load
from demandops.templating import charts
from demandops.templating.charts import merged

from tests.kit import plain_yaml
from tests.kit.config import configuration, edited, skeleton
from tests.unit.templating import write

APPDEF = Path(__file__).parents[3] / "appdefs" / "object-detection-fusion"
CHARTS = ("object-detection", "object-fusion")
CHANGES = plain_yaml.beside(__file__, "chart-values")


def chart_values(chart: str) -> dict[str, Any]:
    return charts.defaults(f"appdefs/{APPDEF.name}/charts/{chart}", skeleton())


def chart_schema(chart: str) -> dict[str, Any]:
    return dict(json.loads((APPDEF / "charts" / chart / "values.schema.json").read_text("utf-8")))


def takes(chart: str, change: dict[str, Any]) -> bool:
    validator = jsonschema_rs.Draft7Validator(chart_schema(chart))
    return validator.is_valid(merged(chart_values(chart), change))


def templates(chart: str) -> dict[str, str]:
    folder = write.LIBRARY if chart == "ros-service" else APPDEF / "charts" / chart
    folder /= "templates"
    return {path.name: path.read_text("utf-8") for path in sorted(folder.iterdir())}


def objects_in(schema: object, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each subschema that describes an object's properties, with its path."""
    if isinstance(schema, dict):
        if "properties" in schema and "type" in schema:
            yield path, schema
        for key, value in schema.items():
            yield from objects_in(value, f"{path}/{key}")


@pytest.mark.parametrize("chart", CHARTS)
def test_a_schema_has_every_value_and_no_other_field(chart: str) -> None:
    schema = chart_schema(chart)
    assert schema["$schema"] == "http://json-schema.org/draft-07/schema#"
    assert {*chart_values(chart), "ros-service", "global"} == {*schema["properties"]}
    described = objects_in(schema)
    assert [path for path, one in described if one.get("additionalProperties") is not False] == []
    assert takes(chart, {})
    assert takes(chart, CHANGES["accepted"])


@pytest.mark.parametrize(
    ("chart", "change"), [(chart, one) for chart in CHARTS for one in CHANGES["refused"][chart]]
)
def test_a_wrong_value_is_refused(chart: str, change: dict[str, Any]) -> None:
    assert not takes(chart, change)


@pytest.mark.parametrize("chart", [write.LIBRARY, *write.CHARTS], ids=lambda chart: chart.name)
def test_every_value_is_described_in_a_table(chart: Path) -> None:
    text = (chart / "README.md").read_text()
    assert text == write.readme(chart), "run python -m tests.unit.templating.write"
    rows = re.findall(r"^\| ([\w.]+) \| \w+ \| `.*` \| (.*) \|$", text, re.MULTILINE)
    assert len(rows) >= 4
    assert all(description.endswith(".") for _, description in rows)


def undescribed(schema: dict[str, Any], path: str = "") -> Iterator[str]:
    """Yield the path of each property that has neither a description nor properties."""
    for name, one in schema["properties"].items():
        if "description" not in one and "properties" in one:
            yield from undescribed(one, f"{path}{name}.")
        elif "description" not in one and name not in ("ros-service", "global"):
            yield path + name


@pytest.mark.parametrize("chart", write.CHARTS, ids=lambda chart: chart.name)
def test_a_schema_has_what_the_library_has_and_describes_it(chart: Path) -> None:
    text = (chart / "values.schema.json").read_text()
    assert text == write.schema(chart), "run python -m tests.unit.templating.write"
    assert [*undescribed(json.loads(text))] == []


METADATA = f"appdefs/{APPDEF.name}/charts/object-detection/Chart.yaml"


@pytest.mark.parametrize(("path", "old", "new", "field", "told"), CHANGES["misfits"])
def test_a_chart_that_does_not_fit_library_or_registry_is_a_fault(
    path: str, old: str, new: str, field: str, told: str
) -> None:
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(edited(path, old, new)))
    (fault,) = [one for one in invalid.value.faults if one.field == field]
    assert fault.file == (METADATA if field.startswith("dep") else "registry/charts.yaml")
    assert told in fault.message


def test_the_first_of_two_imports_of_a_value_counts() -> None:
    assert charts.defaults("appdefs/a", CHANGES["imports"]) == {"x": 1, "y": 2, "own": 1}


def test_inputs_reach_one_configmap_and_nothing_else() -> None:
    users = {name for name, text in templates("object-fusion").items() if ".Values.inputs" in text}
    assert users == {"params-configmap.yaml"}


@pytest.mark.parametrize("chart", (*CHARTS, "ros-service"))
def test_no_template_knows_revision_or_chart_version(chart: str) -> None:
    forbidden = re.compile(r"\.Release\.(Revision|IsUpgrade|IsInstall)|\.Chart\.Version")
    assert [name for name, text in templates(chart).items() if forbidden.search(text)] == []


@pytest.mark.parametrize("chart", (*CHARTS, "ros-service"))
def test_nothing_is_glued_into_a_shell_script(chart: str) -> None:
    for name, text in templates(chart).items():
        scripts = re.findall(r'"-c",? (.+)', text) + re.findall(r'\$check := "(.*)" -', text)
        assert all("{{" not in script for script in scripts), name
    shells = sum(text.count("/bin/bash") for text in templates(chart).values())
    assert shells == (2 if chart == "ros-service" else 0)  # a container's start and its probe
