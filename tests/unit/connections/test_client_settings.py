"""The registry, the inventory and overrides decide how clients run."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from demandops.base.errors import InvalidInput
from demandops.model.config.load import load

from tests.kit.config import configuration, override, skeleton
from tests.kit.goals import application, connection, goal
from tests.kit.memory import MemoryRepo

CLIENTS, BROKERS, IMAGES = "registry/clients.yaml", "inventory/brokers.yaml", "registry/images.yaml"
NODES = "inventory/nodes.yaml"
PATCH = "overrides/tested.yaml"
SKELETONS = "    ros: {rmw: image}\n"
PROBE = {"exec": {"command": ["ros2", "node", "list"]}, "periodSeconds": 30}


def clients(**mqtt: Any) -> dict[str, str]:
    head = {"apiVersion": "demandops/v1", "kind": "Clients"}
    return {CLIENTS: yaml.safe_dump(head | {"mqtt": mqtt})}


def pod(changed: dict[str, str | None] | dict[str, str], **more: Any) -> dict[str, Any]:
    """Return the pod spec of the client at a connection's source."""
    repo = MemoryRepo({**changed})
    repo.send(goal([], [connection(**more)]))
    found = repo.objects("Deployment")
    (name,) = [name for name in found if "-source" in name]
    spec: dict[str, Any] = found[name]["spec"]["template"]["spec"]
    return spec


def refusals(changed: dict[str, str]) -> list[str]:
    with pytest.raises(InvalidInput) as error:
        load(configuration({**changed}))
    return [str(fault) for fault in error.value.faults]


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


def test_the_skeletons_image_and_launch_file_belong_together() -> None:
    (container,) = pod({})["containers"]
    assert container["image"] == "docker.io/rwthika/robotkube-mqtt-client:2025-04"
    assert container["args"][3] == "standalone.launch.ros2.xml"


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
    nodes = skeleton()[NODES]
    assert nodes.count(SKELETONS) == nodes.count("- id: ")
    repo = MemoryRepo({NODES: nodes.replace(SKELETONS, ros)})
    repo.send(goal([application()], [connection()]))
    services = [one["spec"]["values"]["ros"] for one in repo.objects("HelmRelease").values()]
    assert {one["rmwImplementation"] for one in services} == {middleware}
    for deployment in repo.objects("Deployment").values():
        (container,) = deployment["spec"]["template"]["spec"]["containers"]
        found = {one["name"]: one["value"] for one in container["env"]}
        assert found == {"ROS_DOMAIN_ID": "0"} | (
            {"RMW_IMPLEMENTATION": middleware} if middleware else {}
        )


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
    assert container["env"][1:] == [
        {"name": "RMW_IMPLEMENTATION", "value": "rmw_fastrtps_cpp"},
        {"name": "ROS_STATIC_PEERS", "value": "192.0.2.1"},
    ]
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


def test_settings_and_patches_that_are_not_valid_are_named() -> None:
    assert refusals(clients(env={"ROS_DOMAIN_ID": "1"}, launchfile="x")) == [
        "registry/clients.yaml: mqtt.env: ROS_DOMAIN_ID follows from 'ros' of the node in the "
        "inventory; set 'ros' there, and remove ROS_DOMAIN_ID here",
        "registry/clients.yaml: mqtt.launchfile: is not a field here; remove it or correct its "
        "spelling",
    ]
    both = [{"connections": ["*"]}, {"nodes": ["edge"]}]
    assert refusals({PATCH: override(*both, values={"env": {}})}) == [
        "overrides/tested.yaml: select: selects both connections and services, but 'values' fits "
        "only connections (settings of clients) or only services (Helm values); write two "
        "overrides"
    ]
    patch = override({"connections": ["*"]}, values={"resources": {"limits": {"memory": 1}}})
    assert refusals({PATCH: patch}) == [
        "overrides/tested.yaml: values.resources.limits.memory: must be text, not 1; put it in "
        "quotes"
    ]


def test_a_message_that_the_image_does_not_carry_is_refused() -> None:
    nodes = yaml.safe_load(skeleton()[NODES])
    nodes["nodes"][0]["types"] = {"/ego": "perception_msgs/msg/EgoData"}
    repo = MemoryRepo({NODES: yaml.safe_dump(nodes), **clients(messages=["std_msgs"])})
    assert repo.faults(goal([], [connection(topics=["/ego"])])) == [
        "connections[0].source_topics[0]: '/ego' carries messages of perception_msgs, and "
        "mqtt.messages in registry/clients.yaml has only std_msgs; use an image that has the "
        "package, and add the package to mqtt.messages"
    ]
    repo.send(goal([], [connection(topics=["/of-no-known-type".replace("-", "_")])]))


def test_one_setting_pulls_all_images_from_one_registry() -> None:
    text = skeleton()[IMAGES].replace(
        "images:\n", "registry: k3d-registry.localhost:41671\nimages:\n", 1
    )
    text += "  own: {repository: object_fusion, tag: latest}\n"
    text += "  local: {repository: localhost/own/image, tag: latest}\n"
    images = load(configuration({IMAGES: text})).images
    assert {image.repository for image in images.values()} == {
        f"k3d-registry.localhost:41671/{path}"
        for path in (
            "rwthika/robotkube-object-detection",
            "rwthika/robotkube-object-fusion",
            "rwthika/robotkube-k8s-configmap-watcher",
            "rwthika/robotkube-mqtt-client",
            "object_fusion",
            "own/image",
        )
    }


def test_a_brokers_prefix_starts_every_mqtt_topic_at_both_ends() -> None:
    file = yaml.safe_load(skeleton()[BROKERS])
    for broker in file["brokers"]:
        broker["topicPrefix"] = "fleet/one"
    repo = MemoryRepo({BROKERS: yaml.safe_dump(file)})
    repo.send(goal([], [connection("c", topics=["/a"])]))
    bridges = [
        yaml.safe_load(one["data"]["params.yaml"])["/**/*"]["ros__parameters"]["bridge"]
        for one in repo.objects("ConfigMap").values()
    ]
    sent = [bridge["ros2mqtt"]["/a"]["mqtt_topic"] for bridge in bridges if "ros2mqtt" in bridge]
    taken = [bridge["mqtt2ros"]["mqtt_topics"] for bridge in bridges if "mqtt2ros" in bridge]
    assert [sent] == taken == [["fleet/one/mqtt-c/a"]]
