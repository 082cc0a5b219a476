"""The registry, the inventory and overrides decide how clients run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.model.config.load import load

from tests.kit.config import configuration, override, skeleton
from tests.kit.goals import application, connection, goal
from tests.kit.memory import MemoryRepo

CLIENTS, IMAGES = "registry/clients.yaml", "registry/images.yaml"
NODES = "inventory/nodes.yaml"
PATCH = "overrides/tested.yaml"
PROBE = {"exec": {"command": ["ros2", "node", "list"]}, "periodSeconds": 30}


def clients(**mqtt: Any) -> dict[str, str]:
    head = {"apiVersion": "demandops/v1", "kind": "Clients"}
    return {CLIENTS: yaml.safe_dump(head | {"mqtt": mqtt})}


def pod(changed: Mapping[str, str | None], **more: Any) -> dict[str, Any]:
    """Return the pod spec of the client at a connection's source."""
    repo = MemoryRepo(changed)
    repo.send(goal([], [connection(**more)]))
    (found,) = (one for name, one in repo.objects("Deployment").items() if "-source" in name)
    return dict(found["spec"]["template"]["spec"])


def test_without_the_file_a_client_runs_as_the_inventory_says() -> None:
    spec = pod({CLIENTS: None})
    (container,) = spec["containers"]
    assert container["args"][3] == "standalone.launch.xml"
    assert container["resources"] == {
        "requests": {"cpu": "50m", "memory": "64Mi"},
        "limits": {"memory": "256Mi"},
    }
    assert spec["hostNetwork"] is True
    assert not [name for name in container if name.endswith("Probe")]


@pytest.mark.parametrize(
    ("ros", "middleware"),
    [
        ("", "rmw_cyclonedds_cpp"),
        ("    ros: {rmw: rmw_fastrtps_cpp}\n", "rmw_fastrtps_cpp"),
        ("    ros: {rmw: image}\n", ""),
    ],
    ids=["not said", "named", "the images' own"],
)
def test_services_and_clients_of_a_node_have_one_middleware(ros: str, middleware: str) -> None:
    nodes = skeleton()[NODES].replace("    ros: {rmw: image}\n", ros)
    repo = MemoryRepo({NODES: nodes})
    repo.send(goal([application()], [connection()]))
    services = [one["spec"]["values"]["ros"] for one in repo.objects("HelmRelease").values()]
    assert {one["rmwImplementation"] for one in services} == {middleware}
    named = {"RMW_IMPLEMENTATION": middleware} if middleware else {}
    for deployment in repo.objects("Deployment").values():
        (container,) = deployment["spec"]["template"]["spec"]["containers"]
        found = {one["name"]: one["value"] for one in container["env"]}
        assert found == {"ROS_DOMAIN_ID": "0"} | named


def test_each_setting_reaches_the_client() -> None:
    settings = {
        "launchFile": "own.launch.xml",
        "rmw": "rmw_fastrtps_cpp",
        "env": {"ROS_STATIC_PEERS": "192.0.2.1"},
        "resources": {"requests": {"cpu": "1"}, "limits": {"memory": "2Gi"}},
        "hostNetwork": False,
        "livenessProbe": PROBE,
    }
    spec = pod(clients(**settings))
    (container,) = spec["containers"]
    assert container["args"][3] == "own.launch.xml"
    assert {one["name"]: one["value"] for one in container["env"][1:]} == {
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_STATIC_PEERS": "192.0.2.1",
    }
    assert container["resources"] == settings["resources"]
    assert container["livenessProbe"] == PROBE
    assert "hostNetwork" not in spec


def test_an_override_of_connections_patches_the_settings_of_their_clients() -> None:
    values = {"resources": {"limits": {"memory": "1Gi"}}, "launchFile": "debug.launch.xml"}
    text = override({"connections": ["vehicle00/*"]}, values=values)
    (container,) = pod({PATCH: text})["containers"]
    assert container["resources"]["limits"] == {"memory": "1Gi"}
    assert container["resources"]["requests"] == {"cpu": "50m", "memory": "64Mi"}
    assert container["args"][3] == "debug.launch.xml"
    (container,) = pod({PATCH: text}, id="another")["containers"]
    assert container["resources"]["limits"] == {"memory": "256Mi"}


@pytest.mark.parametrize(
    ("select", "values", "field"),
    [
        ([{"connections": ["*"]}, {"nodes": ["edge"]}], {"env": {}}, "select"),
        (
            [{"connections": ["*"]}],
            {"resources": {"limits": {"memory": 1}}},
            "values.resources.limits.memory",
        ),
    ],
    ids=["of services too", "number instead of text"],
)
def test_a_patch_that_does_not_fit_is_refused(select: Any, values: Any, field: str) -> None:
    with pytest.raises(InvalidInput) as invalid:
        load(configuration({PATCH: override(*select, values=values)}))
    (found,) = map(str, invalid.value.faults)
    assert found.startswith(f"{PATCH}: {field}: ")


def test_a_message_that_the_image_does_not_carry_is_refused() -> None:
    nodes = yaml.safe_load(skeleton()[NODES])
    nodes["nodes"][0]["types"] = {"/ego": "perception_msgs/msg/EgoData"}
    repo = MemoryRepo({NODES: yaml.safe_dump(nodes), **clients(messages=["std_msgs"])})
    (found,) = repo.faults(goal([], [connection(topics=["/ego"])]))
    assert found.startswith("connections[0].source_topics[0]: '/ego' carries messages of perc")
    repo.send(goal([], [connection(topics=["/of_no_known_type"])]))


def test_one_setting_pulls_all_images_from_one_registry() -> None:
    text = skeleton()[IMAGES].replace("images:\n", "registry: local.example:41671\nimages:\n", 1)
    text += "  own: {repository: object_fusion, tag: latest}\n"
    text += "  local: {repository: localhost/own/image, tag: latest}\n"
    images = load(configuration({IMAGES: text})).images
    found = {name: image.repository for name, image in images.items()}
    assert all(one.startswith("local.example:41671/") for one in found.values())
    paths = {name: one.partition("/")[2] for name, one in found.items()}
    assert (paths["own"], paths["local"]) == ("object_fusion", "own/image")
    assert paths["mqtt-client"] == "rwthika/robotkube-mqtt-client"
