"""The launch files of the ROS package. Tests cannot run them, because PyPI lacks ROS's launch."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import demandops
import pytest
import yaml

from tests.unit.test_package_layout import setuptools

PACKAGE = Path(__file__).parents[2] / "ros_bridge" / "ros_package"


def test_the_launch_file_takes_the_arguments_of_the_reference_s() -> None:
    launch = ElementTree.parse(PACKAGE / "launch" / "demandops.launch.xml").getroot()  # noqa: S314
    arguments = [each.get("name") for each in launch.findall("arg")]
    assert arguments == ["name", "namespace", "params", "log_level", "args"]
    assert all(each.get("description") for each in launch.findall("arg"))
    (node,) = launch.findall("node")
    assert (node.get("pkg"), node.get("exec")) == ("demandops_ros", "serve")
    used = re.findall(r"\$\(var (\w+)\)", ElementTree.tostring(node, "unicode"))
    assert sorted(used) == sorted(arguments)
    # the values of the file come last, so they take precedence
    assert [sorted(each.keys()) for each in node.findall("param")] == [["name", "value"], ["from"]]


def test_the_parameter_file_has_the_defaults() -> None:
    parameters = pytest.importorskip("demandops_ros.node_parameters")
    data: dict[str, Any] = yaml.safe_load((PACKAGE / "config" / "params.yaml").read_text())
    named = data["/**"]["ros__parameters"]
    assert named == {name: parameters.DEFAULTS[name] for name in named}
    assert set(parameters.DEFAULTS) - set(named) == {"state_repo", "fetch_interval", "log_level"}


def test_the_launch_file_of_the_detector_uses_all_its_arguments() -> None:
    launch = ElementTree.parse(PACKAGE / "launch" / "detector.launch.xml").getroot()  # noqa: S314
    arguments = [each.get("name") for each in launch.findall("arg")]
    assert all(each.get("description") for each in launch.findall("arg"))
    (node,) = launch.findall("node")
    assert (node.get("pkg"), node.get("exec")) == ("demandops_ros", "detect")
    used = re.findall(r"\$\(var (\w+)\)", ElementTree.tostring(node, "unicode"))
    assert sorted(used) == sorted(arguments)


def test_the_parameter_file_of_the_detector_has_the_defaults() -> None:
    parameters = pytest.importorskip("demandops_ros.detector.detect_command").PARAMETERS
    data = yaml.safe_load((PACKAGE / "config" / "detector_params.yaml").read_text())
    named = data["/**"]["ros__parameters"]
    assert named == {name: parameters[name][0] for name in named}
    assert set(parameters) - set(named) == {"rules", "log_level"}


def test_the_package_has_the_version_and_the_needs_of_the_code() -> None:
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()  # noqa: S314
    assert manifest.findtext("version") == demandops.__version__
    code = "".join(path.read_text() for path in PACKAGE.parent.glob("demandops_ros/**/*.py"))
    imported = set(re.findall(r"^(?:from|import) (\w+(?:_msgs|_interfaces)|rclpy)\b", code, re.M))
    assert {each.text for each in manifest.findall("exec_depend")} >= imported


def test_the_wheel_and_colcon_install_the_same_files() -> None:
    folders = setuptools()["data-files"]
    installed = {
        Path(file)
        for folder in folders
        if "demandops_ros" in folder or "ament" in folder
        for file in folders[folder]
    }
    kept = {path for path in PACKAGE.rglob("*") if path.is_file()} - {PACKAGE / "CMakeLists.txt"}
    assert {PACKAGE.parents[1] / path for path in installed} == kept
