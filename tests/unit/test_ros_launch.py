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


@pytest.mark.parametrize(("name", "program"), [("demandops", "serve"), ("detector", "detect")])
def test_a_launch_file_uses_all_its_arguments(name: str, program: str) -> None:
    launch = ElementTree.parse(PACKAGE / "launch" / f"{name}.launch.xml").getroot()  # noqa: S314
    arguments = [each.get("name") for each in launch.findall("arg")]
    assert all(each.get("description") for each in launch.findall("arg"))
    (node,) = launch.findall("node")
    assert (node.get("pkg"), node.get("exec")) == ("demandops_ros", program)
    used = re.findall(r"\$\(var (\w+)\)", ElementTree.tostring(node, "unicode"))
    assert sorted(used) == sorted(filter(None, arguments))
    if name == "demandops":  # as the reference's
        assert arguments == ["name", "namespace", "params", "log_level", "args"]
        # the values of the file come last, so they take precedence
        given = [sorted(each.keys()) for each in node.findall("param")]
        assert given == [["name", "value"], ["from"]]


def test_the_parameter_files_have_the_defaults() -> None:
    node = pytest.importorskip("demandops_ros.node_parameters").DEFAULTS
    command = pytest.importorskip("demandops_ros.detector.detect_command")
    detector = {name: default for name, (default, *_) in command.PARAMETERS.items()}
    of_node = (node, {"state_repo", "fetch_interval", "log_level"})
    of_detector = (detector, {"rules", "log_level"})
    for file, (defaults, left_out) in {"params": of_node, "detector_params": of_detector}.items():
        data: dict[str, Any] = yaml.safe_load((PACKAGE / "config" / f"{file}.yaml").read_text())
        named = data["/**"]["ros__parameters"]
        assert named == {name: defaults[name] for name in defaults.keys() - left_out}


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
