"""The charts of object detection and fusion, as far as they can be judged without Helm.

Schemas, default values and values templates are checked here against each other; what the charts
render is checked with the real Helm in tests/e2e.
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
from jinja2 import StrictUndefined, Undefined
from jinja2.sandbox import ImmutableSandboxedEnvironment

APPDEF = Path(__file__).parents[3] / "appdefs" / "object-detection-fusion"
CHARTS = ("object-detection", "object-fusion")

NODE: dict[str, Any] = {
    "id": "edge",
    "selector": {"node_id": "edge"},
    "tolerations": [{"key": "edge", "operator": "Exists", "effect": "NoSchedule"}],
    "image_pull_secrets": [],
    "host_network": False,
    "ros": {"domain_id": 7, "rmw": "rmw_fastrtps_cpp"},
}
IMAGES = {
    name: {"repository": f"ghcr.io/example/{name}", "tag": "1.2", "digest": ""}
    for name in ("object-detection", "object-fusion", "k8s-configmap-watcher")
}
CONTEXTS: dict[str, dict[str, Any]] = {
    "object-detection": {
        "release": "od-edge-vehicle00",
        "service": "object-detection",
        "node": NODE,
        "source": "vehicle00",
        "source_topic": "/vehicle00/points",
        "inputs": {
            "point_cloud": [{"topic": "/vehicle00/points", "source": "vehicle00", "type": ""}]
        },
        "outputs": {"object_list": "/vehicle00_local_objectlist"},
        "parameters": {},
        "images": IMAGES,
        "replicas": 1,
    },
    "object-fusion": {
        "release": "of-edge-object-detection-fusion",
        "service": "object-fusion",
        "node": NODE,
        "application": "edge/object_detection_fusion",
        "inputs": {
            "ego_data": [
                {"topic": "/vehicle00/ego", "source": "vehicle00", "type": ""},
                {"topic": "/vehicle01/ego", "source": "vehicle01", "type": ""},
            ],
            "object_list": [
                {"topic": "/station00_local_objectlist", "source": "station00", "type": ""},
            ],
        },
        "outputs": {
            "fused_objects": "/fused_objects",
            "fused_trajectories": "/fused_trajectories",
            "raw_objects": "/raw_objects",
        },
        "parameters": {},
        "images": IMAGES,
        "replicas": 1,
    },
}


def chart_values(chart: str) -> dict[str, Any]:
    return dict(yaml.safe_load((APPDEF / "charts" / chart / "values.yaml").read_text("utf-8")))


def chart_schema(chart: str) -> dict[str, Any]:
    return dict(json.loads((APPDEF / "charts" / chart / "values.schema.json").read_text("utf-8")))


def faults(chart: str, values: dict[str, Any]) -> list[str]:
    validator = jsonschema_rs.Draft7Validator(chart_schema(chart))
    return [error.message for error in validator.iter_errors(values)]


def as_json(value: object) -> str:
    if isinstance(value, Undefined):
        str(value)  # a StrictUndefined says here which name is missing
    return json.dumps(value)


def render(chart: str, **changes: object) -> dict[str, Any]:
    """Render the values template of ``chart`` the way the generator's engine does."""
    environment = ImmutableSandboxedEnvironment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, finalize=as_json
    )
    environment.filters["ros_name"] = lambda name: name.replace("-", "_")
    source = (APPDEF / "values" / f"{chart}.yaml.j2").read_text("utf-8")
    return dict(yaml.safe_load(environment.from_string(source).render(CONTEXTS[chart] | changes)))


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


@pytest.mark.parametrize("chart", CHARTS)
@pytest.mark.parametrize("secrets", [[], ["one", "two"]])
def test_rendered_values_satisfy_the_schema(chart: str, secrets: list[str]) -> None:
    values = render(chart, node={**NODE, "image_pull_secrets": secrets, "host_network": True})
    assert faults(chart, merged(chart_values(chart), values)) == []
    assert values.get("imagePullSecrets", []) == [{"name": secret} for secret in secrets]
    assert values["hostNetwork"] is True
    assert values["nodeSelector"] == NODE["selector"]
    assert values["tolerations"] == NODE["tolerations"]
    assert values["ros"] == {"domainId": 7, "rmwImplementation": "rmw_fastrtps_cpp"}


def test_values_of_a_detection() -> None:
    assert render("object-detection")["detection"] == {
        "nodeName": "od_edge_vehicle00",
        "pointCloudTopic": "/vehicle00/points",
        "objectListTopic": "/vehicle00_local_objectlist",
    }


def test_values_of_a_fusion() -> None:
    values = render("object-fusion")
    assert values["fusion"] == {
        "nodeName": "of_edge_object_detection_fusion",
        "rawObjectListsTopic": "/raw_objects",
        "fusedObjectListsTopic": "/fused_objects",
        "fusedTrajectoriesTopic": "/fused_trajectories",
    }
    assert values["inputs"] == {
        "egoData": ["/vehicle00/ego", "/vehicle01/ego"],
        "objectList": ["/station00_local_objectlist"],
    }
    assert values["watcher"] == {
        "image": IMAGES["k8s-configmap-watcher"],
        "nodeName": "of_edge_object_detection_fusion__watcher",
    }


def test_a_topic_of_two_sources_is_read_once() -> None:
    twice = [{"topic": topic, "source": "v", "type": ""} for topic in ("/A", "/a", "/a")]
    values = render("object-fusion", inputs={"ego_data": twice, "object_list": []})
    assert values["inputs"]["egoData"] == ["/A", "/a"]


@pytest.mark.parametrize("given", [{}, {"use_sim_time": False}])
def test_simulated_time_is_the_charts_unless_demanded(given: dict[str, bool]) -> None:
    fusion = render("object-fusion", parameters=given)["fusion"]
    assert fusion.get("useSimTime", "default") == given.get("use_sim_time", "default")


def test_a_hostile_topic_stays_text_and_the_schema_refuses_it() -> None:
    hostile = '/a"\n}: {{ x }} $(reboot) #'
    values = render("object-detection", source_topic=hostile)
    assert values["detection"]["pointCloudTopic"] == hostile
    assert faults("object-detection", merged(chart_values("object-detection"), values))


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
