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

from tests.kit import plain_yaml
from tests.kit.config import configuration
from tests.kit.goals import application
from tests.kit.ros import Client, Serve

FILES = plain_yaml.load(Path(__file__).with_name("parameters.yaml").read_text())
EXPERIMENT = FILES["of the experiment"]
PAGE = Path(__file__).parents[2] / "docs" / "reference.md"


@pytest.fixture
def ros() -> Iterator[None]:
    rclpy.init(args=[])
    yield
    rclpy.try_shutdown()


def assert_warned(told: list[str], expected: dict[str, str]) -> None:
    """Check that each unused parameter is told, with words of what to do instead."""
    assert len(told) == len(expected)
    for line, (name, words) in zip(told, expected.items(), strict=True):
        assert line.startswith(f"parameter {name} of the reference is not used: ")
        assert words in line


def told(folder: Path, text: str, **files: str) -> list[str]:
    file = folder / "params.yml"
    file.write_text(text)
    # a launch file sets the node's name like this
    args = ["--ros-args", "-r", "__node:=demandops", "--params-file", str(file)]
    values = node_parameters.read_reference_parameters(args)
    assert values["deployment_action_name"] == "/fleet/deployment_request"
    return list(node_parameters.warnings(values, load(configuration(files))))


def test_parameters_of_the_reference_are_told_if_they_are_not_used(
    ros: None, tmp_path: Path
) -> None:
    for file in FILES.values():
        assert_warned(told(tmp_path, file["text"]), file["unused"])
    name = "connections.communication_broker.host"  # without a port it is any broker of the host
    config = load(configuration({}))
    for host, count in (("service-mqtt-broker-edge", 0), ("elsewhere", 1)):
        assert len([*node_parameters.warnings({name: host}, config)]) == count


def test_the_page_names_the_images_as_the_registry_has_them(ros: None, tmp_path: Path) -> None:
    block = r"```yaml\n(# registry/images.yaml\n.*?)```"
    (images,) = re.findall(block, PAGE.read_text(), re.DOTALL)
    files = {"registry/images.yaml": images}
    assert_warned(
        told(tmp_path, EXPERIMENT["text"], **files), {"cluster_config": "give --clusters"}
    )
    # the names in object_detection_fusion_app.py and mqtt_connection.py of application_manager
    services = ("point_cloud_object_detection", "object_fusion", "k8s_configmap_watcher")
    assert {image.reference() for image in load(configuration(files)).images.values()} == {
        f"k3d-registry.localhost:41671/{name}:latest" for name in ("mqtt_client", *services)
    }


def test_the_parameter_file_of_the_package_leaves_options_alone() -> None:
    file = Path(node_parameters.__file__).parents[1] / "ros_package" / "config" / "params.yaml"
    rclpy.init(args=["--ros-args", "--params-file", str(file)])
    try:
        read = node_parameters.read_node_parameters(
            {"state_repo": "fleet.git", "fetch_interval": "5s"}
        )
    finally:
        rclpy.try_shutdown()
    defaults = {name: each.default for name, each in node_parameters.PARAMETERS.items()}
    assert read == defaults | {"state_repo": "fleet.git", "fetch_interval": "5s"}


def test_a_node_starts_with_the_file(tmp_path: Path, serve: Serve, ros_domain: int) -> None:
    file = tmp_path / "params.yml"
    file.write_text(EXPERIMENT["text"])
    args = ["--ros-args", "-r", "__node:=demandops", "--params-file", str(file)]
    served = serve(None, *args, "-p", "answer_timeout:=7.5")
    client = Client(ros_domain, "/fleet/deployment_request")
    try:
        client.ready()
        assert client.call({"id": "a", "apps": [application()]}).status == "succeeded"
        service = client.node.create_client(DescribeParameters, "/demandops/describe_parameters")
        client.wait(service.service_is_ready)
        future = service.call_async(
            DescribeParameters.Request(names=list(node_parameters.PARAMETERS))
        )
        client.wait(future.done)
        described = {one.name: one for one in future.result().descriptors}
    finally:
        client.close()
    assert all(one.description.endswith(".") and one.read_only for one in described.values())
    assert described["answer"].additional_constraints == "one of pushed, reconciled, healthy"
    assert described["answer_timeout"].additional_constraints == "0.001 to 86400"
    log = served.log.read_text().splitlines()
    warned = [line.removeprefix("warning: ") for line in log if line.startswith("warning: ")]
    assert_warned(warned, EXPERIMENT["unused"])
