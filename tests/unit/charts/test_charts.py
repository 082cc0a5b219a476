"""The charts of object detection and fusion, as far as they can be judged without Helm.

Schemas and default values are checked here against each other. tests/golden holds the values that
the generator gives; what the charts render is checked with the real Helm in tests/e2e.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
import yaml

from tests.kit.config import edited
from tests.kit.goals import EGO, application, goal
from tests.kit.memory import MemoryRepo

APPDEF = Path(__file__).parents[3] / "appdefs" / "object-detection-fusion"
CHARTS = ("object-detection", "object-fusion")


def chart_values(chart: str) -> dict[str, Any]:
    return dict(yaml.safe_load((APPDEF / "charts" / chart / "values.yaml").read_text("utf-8")))


def chart_schema(chart: str) -> dict[str, Any]:
    return dict(json.loads((APPDEF / "charts" / chart / "values.schema.json").read_text("utf-8")))


def faults(chart: str, values: dict[str, Any]) -> list[str]:
    validator = jsonschema_rs.Draft7Validator(chart_schema(chart))
    return [error.message for error in validator.iter_errors(values)]


def merged(defaults: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Lay ``values`` over a chart's defaults as Helm does: maps are united, lists replaced."""
    result = copy.deepcopy(defaults)
    for key, value in values.items():
        both_maps = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merged(result[key], value) if both_maps else value
    return result


def templates(chart: str) -> dict[str, str]:
    folder = APPDEF / "charts" / chart / "templates"
    return {path.name: path.read_text("utf-8") for path in sorted(folder.iterdir())}


def objects_in(schema: object, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every subschema that describes an object's properties."""
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
def test_every_value_is_listed_and_commented(chart: str) -> None:
    assert set(chart_values(chart)) == set(chart_schema(chart)["properties"])
    lines = (APPDEF / "charts" / chart / "values.yaml").read_text("utf-8").splitlines()
    top = [number for number, line in enumerate(lines) if re.match(r"[a-zA-Z]+:", line)]
    described = ("image:", "ros:", "detection:", "fusion:", "watcher:", "serviceAccount:")
    bare = [
        lines[number]
        for number in top
        if not lines[number - 1].startswith("#") and not lines[number].startswith(described)
    ]
    assert bare == []


def test_the_charts_share_their_ros_helpers_and_definitions() -> None:
    first, second = CHARTS
    for name in ("_ros.tpl", "serviceaccount.yaml"):
        assert templates(first)[name] == templates(second)[name]
    assert chart_schema(first)["definitions"] == chart_schema(second)["definitions"]


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
    }
    assert faults(chart, merged(chart_values(chart), change)) == []


def test_a_topic_of_two_sources_is_read_once() -> None:
    repo = MemoryRepo()
    topics = [("/a", "vehicle01"), ("/A", "vehicle01"), ("/a", "vehicle00")]
    repo.send(goal([application(ego=topics, clouds=[])]))
    (release,) = repo.objects("HelmRelease").values()
    assert release["spec"]["values"]["inputs"]["egoData"] == ["/A", "/a"]


def test_a_definition_may_take_simulated_time_as_a_parameter() -> None:
    parameter = "parameters: {use_sim_time: {default: false}}\nservices:\n"
    repo = MemoryRepo(edited(f"appdefs/{APPDEF.name}/appdef.yaml", "services:\n", parameter))
    repo.send(goal([application(ego=[EGO], clouds=[])]))
    (release,) = repo.objects("HelmRelease").values()
    assert release["spec"]["values"]["fusion"]["useSimTime"] is False


def test_inputs_reach_one_configmap_and_nothing_else() -> None:
    users = {name for name, text in templates("object-fusion").items() if ".Values.inputs" in text}
    assert users == {"params-configmap.yaml"}


@pytest.mark.parametrize("chart", CHARTS)
def test_no_template_knows_revision_or_chart_version(chart: str) -> None:
    forbidden = re.compile(r"\.Release\.(Revision|IsUpgrade|IsInstall)|\.Chart\.Version")
    assert [name for name, text in templates(chart).items() if forbidden.search(text)] == []


@pytest.mark.parametrize("chart", CHARTS)
def test_nothing_is_glued_into_a_shell_script(chart: str) -> None:
    for name, text in templates(chart).items():
        scripts = re.findall(r'"-c",? (.+)', text) + re.findall(r'\$check := "(.*)" -', text)
        assert all("{{" not in script for script in scripts), name
    text = templates(chart)["_ros.tpl"]
    assert text.count("/bin/bash") == 2  # the start of a container and the probe
