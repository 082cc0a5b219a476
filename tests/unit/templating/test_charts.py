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
import yaml
from demandops.base.errors import InvalidInput
from demandops.model.config.load import load
from demandops.templating import charts
from demandops.templating.charts import merged

from tests.kit.config import configuration, edited, skeleton
from tests.kit.goals import application, goal
from tests.kit.memory import MemoryRepo
from tests.unit.templating import write

APPDEF = Path(__file__).parents[3] / "appdefs" / "object-detection-fusion"
CHARTS = ("object-detection", "object-fusion")


def chart_values(chart: str) -> dict[str, Any]:
    return charts.defaults(f"appdefs/{APPDEF.name}/charts/{chart}", skeleton())


def chart_schema(chart: str) -> dict[str, Any]:
    return dict(json.loads((APPDEF / "charts" / chart / "values.schema.json").read_text("utf-8")))


def faults(chart: str, values: dict[str, Any]) -> list[str]:
    validator = jsonschema_rs.Draft7Validator(chart_schema(chart))
    return [error.message for error in validator.iter_errors(values)]


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
def test_chart_metadata(chart: str) -> None:
    metadata = yaml.safe_load((APPDEF / "charts" / chart / "Chart.yaml").read_text("utf-8"))
    assert metadata["name"] == chart
    assert metadata["apiVersion"] == "v2"
    assert metadata["version"] == "0.1.0"
    assert metadata["appVersion"] == "2025-04"


@pytest.mark.parametrize("chart", CHARTS)
def test_schema_is_valid_draft_7_and_accepts_the_defaults(chart: str) -> None:
    schema = chart_schema(chart)
    assert schema["$schema"] == "http://json-schema.org/draft-07/schema#"
    assert faults(chart, chart_values(chart)) == []


@pytest.mark.parametrize("chart", CHARTS)
def test_every_object_of_the_schema_is_closed(chart: str) -> None:
    still_open = [
        path
        for path, schema in objects_in(chart_schema(chart))
        if schema.get("additionalProperties") is not False
    ]
    assert still_open == []


@pytest.mark.parametrize("chart", CHARTS)
def test_every_value_is_in_the_schema(chart: str) -> None:
    assert {*chart_values(chart), "ros-service", "global"} == {*chart_schema(chart)["properties"]}


@pytest.mark.parametrize("chart", [write.LIBRARY, *write.CHARTS], ids=lambda chart: chart.name)
def test_every_value_is_described_in_a_table(chart: Path) -> None:
    text = (chart / "README.md").read_text()
    assert text == write.readme(chart), "run python -m tests.unit.templating.write"
    rows = re.findall(r"^\| ([\w.]+) \| \w+ \| `.*` \| (.*) \|$", text, re.MULTILINE)
    assert len(rows) >= 4
    assert all(description.endswith(".") for _, description in rows)


@pytest.mark.parametrize("chart", write.CHARTS, ids=lambda chart: chart.name)
def test_a_schema_has_what_the_library_has(chart: Path) -> None:
    text = (chart / "values.schema.json").read_text()
    assert text == write.schema(chart), "run python -m tests.unit.templating.write"


def undescribed(schema: dict[str, Any], path: str = "") -> Iterator[str]:
    """Yield the path of each property without a description.

    A property with properties of its own needs no description, but its properties do.
    """
    for name, one in schema["properties"].items():
        if "description" not in one and "properties" in one:
            yield from undescribed(one, f"{path}{name}.")
        elif "description" not in one and name not in ("ros-service", "global"):
            yield path + name


@pytest.mark.parametrize("chart", write.CHARTS, ids=lambda chart: chart.name)
def test_every_property_of_a_schema_has_a_description(chart: Path) -> None:
    schema = json.loads((chart / "values.schema.json").read_text())
    assert [*undescribed(schema)] == []


METADATA = f"appdefs/{APPDEF.name}/charts/object-detection/Chart.yaml"


@pytest.mark.parametrize(
    ("path", "old", "new", "told"),
    [
        (
            METADATA,
            "file://../../../charts/ros-service",
            "file://../ros-service",
            "dependencies[0].repository: 'file://../ros-service': "
            "'appdefs/object-detection-fusion/charts/ros-service/Chart.yaml' does not exist; "
            "correct the path, which is relative to the chart's folder and must not lead out of "
            "appdefs/",
        ),
        (
            METADATA,
            "file://../../../charts/ros-service",
            "file://../../../../other/ros-service",
            "dependencies[0].repository: 'file://../../../../other/ros-service': that folder is "
            "not in appdefs/; correct the path, which is relative to the chart's folder and must "
            "not lead out of appdefs/",
        ),
        (
            METADATA,
            "ros-service\n    version: 1.0.0",
            "ros-service\n    version: 0.2.0",
            "dependencies[0].version: requires 0.2.0, but the library in "
            "appdefs/charts/ros-service is version 1.0.0; make the versions equal",
        ),
    ],
)
def test_a_library_that_is_not_there_is_a_fault(path: str, old: str, new: str, told: str) -> None:
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(edited(path, old, new)))
    assert [str(fault) for fault in invalid.value.faults] == [f"{METADATA}: {told}"]


@pytest.mark.parametrize(
    ("path", "old", "new", "told"),
    [
        (
            "registry/charts.yaml",
            "folder: appdefs/object-detection-fusion/charts/object-detection\n",
            "folder: charts/object-detection\n",
            "registry/charts.yaml: charts.object-detection.folder: 'charts/object-detection' is "
            "not in appdefs/; move the chart there",
        ),
        (
            METADATA,
            "\nversion: 0.1.0",
            "\n",
            "registry/charts.yaml: charts.object-detection.version: is 0.1.0, but "
            f"{METADATA} has no version; add it there",
        ),
    ],
)
def test_a_chart_that_does_not_fit_the_registry_is_a_fault(
    path: str, old: str, new: str, told: str
) -> None:
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(edited(path, old, new)))
    assert told in [str(fault) for fault in invalid.value.faults]


@pytest.mark.parametrize(
    ("chart", "path", "value"),
    [
        ("object-detection", "replica", 1),
        ("object-detection", "image.tags", "1"),
        ("object-detection", "image.tag", 2025),
        ("object-detection", "image.digest", "sha256:abc"),
        ("object-detection", "image.repository", "example.org/image:tag"),
        ("object-detection", "image.pullPolicy", "Sometimes"),
        ("object-detection", "imagePullSecrets", ["secret"]),
        ("object-detection", "tolerations", [{"keys": "edge"}]),
        ("object-detection", "affinity.nodeAfinity", {}),
        ("object-detection", "nodeSelector.node_id", 7),
        ("object-detection", "ros.domainId", 233),
        ("object-detection", "ros.env", [{"name": "ROS_DOMAIN_ID", "value": "1"}]),
        ("object-detection", "ros.env", [{"name": "A", "value": "1", "valueFrom": {}}]),
        ("object-detection", "detection.pointcloudTopic", "/points"),
        ("object-detection", "detection.pointCloudTopic", "/points; reboot"),
        ("object-detection", "detection.pointCloudTopic", "/points\n"),
        ("object-detection", "detection.pointCloudTopic", "$(reboot)"),
        ("object-detection", "detection.nodeName", "od-edge"),
        ("object-detection", "probes.live", {}),
        ("object-detection", "probes.startup.period", 1),
        ("object-detection", "resources.limit", {}),
        ("object-detection", "resources.limits.memory", "2Gb"),
        ("object-detection", "securityContext.capabilities.dropped", ["ALL"]),
        ("object-detection", "workspaceSetup", ["setup.bash"]),
        ("object-detection", "workspaceSetup", ["--"]),
        ("object-detection", "runtimeClassName", "Not A Name"),
        ("object-detection", "commonLabels.team", 7),
        ("object-fusion", "fusion.useSimtime", True),
        ("object-fusion", "fusion.useSimTime", "true"),
        ("object-fusion", "inputs.egodata", []),
        ("object-fusion", "inputs.egoData", [""]),
        ("object-fusion", "inputs.objectList", ["/a", "b c"]),
        ("object-fusion", "watcher.period", 0),
        ("object-fusion", "watcher.configPath", "relative/path"),
        ("object-fusion", "serviceAccount.create", False),
    ],
)
def test_a_wrong_value_is_refused(chart: str, path: str, value: object) -> None:
    change: object = value
    for key in reversed(path.split(".")):
        change = {key: change}
    assert isinstance(change, dict)
    assert faults(chart, merged(chart_values(chart), change))


@pytest.mark.parametrize("chart", CHARTS)
def test_values_that_people_override_are_accepted(chart: str) -> None:
    change = {
        "replicas": 0,
        "image": {"digest": "sha256:" + "0f" * 32},
        "imagePullSecrets": [{"name": "registry"}],
        "affinity": {"nodeAffinity": {}},
        "ros": {"env": [{"name": "A", "valueFrom": {"fieldRef": {"fieldPath": "status.podIP"}}}]},
        "workspaceSetup": [],
        "probes": {"startup": None, "liveness": {"exec": {"command": ["true"]}}},
        "resources": {"limits": {"nvidia.com/gpu": 1}},
        "podLabels": {"example.org/team": "perception"},
        "commonLabels": {"example.org/team": "perception"},
        "fullnameOverride": "detection",
        "priorityClassName": "high",
        "runtimeClassName": "nvidia",
    }
    assert faults(chart, merged(chart_values(chart), change)) == []


def test_the_first_of_two_imports_of_a_value_counts() -> None:
    imports = "[{name: lib, repository: 'file://../lib', import-values: [first, second]}]"
    files = {
        "appdefs/a/Chart.yaml": f"name: a\nversion: 1.0.0\ndependencies: {imports}\n",
        "appdefs/a/values.yaml": "own: 1\n",
        "appdefs/lib/values.yaml": "exports:\n  first: {x: 1}\n  second: {x: 2, y: 2, own: 2}\n",
    }
    assert charts.defaults("appdefs/a", files) == {"x": 1, "y": 2, "own": 1}


def test_a_topic_of_two_sources_is_read_once() -> None:
    repo = MemoryRepo()
    topics = [("/a", "vehicle01"), ("/A", "vehicle01"), ("/a", "vehicle00")]
    repo.send(goal([application(ego=topics, clouds=[])]))
    (release,) = repo.objects("HelmRelease").values()
    assert release["spec"]["values"]["inputs"]["egoData"] == ["/A", "/a"]


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
