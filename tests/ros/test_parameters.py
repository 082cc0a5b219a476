"""The node's parameters, and the reference's parameter file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from demandops.model.config.load import load
from demandops_ros import node_parameters
from rcl_interfaces.srv import DescribeParameters

from tests.kit.config import configuration
from tests.kit.goals import application
from tests.kit.ros import Client, Serve

FILE = """
application_manager:
  ros__parameters:
    cluster_config: config/cluster_config.yml
    deployment_action_name: /fleet/deployment_request
    namespace: NAMESPACE
    k3d_image_registry: "k3d-registry.localhost:41671"
    connections:
      communication_broker_nodes: [cloud, edge]
      communication_broker_params:
        cloud: {host: service-mqtt-broker-cloud, port: 1883}
        edge: {host: service-mqtt-broker-edge, port: PORT}
"""
OLDER = """
application_manager:
  ros__parameters:
    namespace: perception
    deployment_action_name: /fleet/deployment_request
    helm_release_tag: appmanager
    url_application_registry: https://example.org/charts
    applications: {event_detector_database: {database: {name: mongodb, port: 27017}}}
    connections:
      init_comm_topics: [/vehicles/vehicle00/pose]
      communication_broker: {host: broker, port: 1883}
"""
UNUSED = "of the reference is not used:"
PAGE = Path(__file__).parents[2] / "docs" / "migration.md"


@pytest.fixture
def ros() -> Iterator[None]:
    rclpy.init(args=[])
    yield
    rclpy.try_shutdown()


def told(folder: Path, text: str, **files: str) -> list[str]:
    file = folder / "params.yml"
    file.write_text(text)
    # a launch file sets the node's name like this
    args = ["--ros-args", "-r", "__node:=demandops", "--params-file", str(file)]
    values = node_parameters.read_reference_parameters(args)
    assert values["deployment_action_name"] == "/fleet/deployment_request"
    return list(node_parameters.warnings(values, load(configuration(files))))


REPLACED = [
    f"parameter cluster_config {UNUSED} a GitOps controller applies what is committed; if the "
    "node shall not answer a goal before its releases are reconciled or healthy, give --clusters, "
    "and set the parameter answer to one of them",
    f"parameter k3d_image_registry {UNUSED} set the field 'registry' to "
    "k3d-registry.localhost:41671 in registry/images.yaml, and give the images the names that they "
    "have in that registry (docs/migration.md)",
]


def test_a_file_whose_brokers_are_in_the_inventory(ros: None, tmp_path: Path) -> None:
    text = FILE.replace("NAMESPACE", "perception").replace("PORT", "1993")
    assert told(tmp_path, text) == REPLACED


def test_the_page_names_the_images_as_the_registry_has_them(ros: None, tmp_path: Path) -> None:
    text = FILE.replace("NAMESPACE", "perception").replace("PORT", "1993")
    (images,) = re.findall(
        r"```yaml\n(# registry/images.yaml\n.*?)```", PAGE.read_text(), re.DOTALL
    )
    files = {"registry/images.yaml": images}
    assert told(tmp_path, text, **files) == REPLACED[:1]
    # the names in object_detection_fusion_app.py and mqtt_connection.py of application_manager
    assert {image.reference() for image in load(configuration(files)).images.values()} == {
        f"k3d-registry.localhost:41671/{name}:latest"
        for name in (
            "mqtt_client",
            "point_cloud_object_detection",
            "object_fusion",
            "k8s_configmap_watcher",
        )
    }


def test_what_the_state_repo_lacks_is_named(ros: None, tmp_path: Path) -> None:
    text = FILE.replace("NAMESPACE", "default").replace("PORT", "1994")
    assert told(tmp_path, text) == [
        REPLACED[0],
        f"parameter namespace {UNUSED} 'default' is not a namespace in "
        "policy/access-domains.yaml; services run in the namespace of their access domain",
        REPLACED[1],
        f"parameter connections.communication_broker_params.edge.host {UNUSED} the broker of node "
        "'edge' at service-mqtt-broker-edge:1994 is not in inventory/brokers.yaml; add it there",
    ]


def test_a_broker_without_a_port_is_any_broker_of_the_host() -> None:
    name = "connections.communication_broker.host"
    config = load(configuration({}))
    assert [*node_parameters.warnings({name: "service-mqtt-broker-edge"}, config)] == []
    (warning,) = node_parameters.warnings({name: "elsewhere"}, config)
    assert "the broker at elsewhere is not in inventory/brokers.yaml" in warning


def test_the_parameters_of_an_older_file(ros: None, tmp_path: Path) -> None:
    assert told(tmp_path, OLDER) == [
        f"parameter helm_release_tag {UNUSED} the GitOps controller removes releases that are no "
        "longer demanded",
        f"parameter url_application_registry {UNUSED} registry/charts.yaml names where each chart "
        "comes from",
        f"parameter applications {UNUSED} values of services are in the application definitions, "
        "appdefs/",
        f"parameter connections.communication_broker.host {UNUSED} the broker at broker:1883 is "
        "not in inventory/brokers.yaml; add it there",
        f"parameter connections.init_comm_topics {UNUSED} add /vehicles/vehicle00/pose to the "
        "field 'bridged' of the source node in inventory/nodes.yaml",
    ]


def test_the_parameter_file_of_the_package_leaves_options_alone() -> None:
    file = Path(node_parameters.__file__).parents[1] / "ros_package" / "config" / "params.yaml"
    rclpy.init(args=["--ros-args", "--params-file", str(file)])
    try:
        read = node_parameters.read_node_parameters(
            {"state_repo": "fleet.git", "fetch_interval": "5s"}
        )
    finally:
        rclpy.try_shutdown()
    assert read == node_parameters.DEFAULTS | {"state_repo": "fleet.git", "fetch_interval": "5s"}


def test_a_node_starts_with_the_file(tmp_path: Path, serve: Serve, ros_domain: int) -> None:
    file = tmp_path / "params.yml"
    file.write_text(FILE.replace("NAMESPACE", "perception").replace("PORT", "1993"))
    args = ["--ros-args", "-r", "__node:=demandops", "--params-file", str(file)]
    served = serve(None, *args, "-p", "answer_timeout:=7.5")
    client = Client(ros_domain, "/fleet/deployment_request")
    try:
        client.ready()
        assert client.call({"id": "a", "apps": [application()]}).status == "succeeded"
        service = client.node.create_client(DescribeParameters, "/demandops/describe_parameters")
        client.wait(service.service_is_ready)
        future = service.call_async(
            DescribeParameters.Request(names=list(node_parameters.DEFAULTS))
        )
        client.wait(future.done)
        described = {one.name: one for one in future.result().descriptors}
    finally:
        client.close()
    assert all(one.description.endswith(".") and one.read_only for one in described.values())
    assert described["answer"].additional_constraints == "one of pushed, reconciled, healthy"
    (limits,) = described["answer_timeout"].floating_point_range
    assert (limits.from_value, limits.to_value) == (0.001, 86_400.0)
    log = served.log.read_text()
    assert [line for line in log.splitlines() if line.startswith("warning: ")] == [
        f"warning: {text}" for text in REPLACED
    ]
