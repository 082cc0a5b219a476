"""The ROS packages build in a colcon workspace, as they do in a ROS 2 installation.

In the tests, the ROS 2 wheels of PyPI are the underlay of the workspace. These wheels lack ros2run
and ros2launch, so the tests launch nothing. They only check the files that both would look up.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

BRIDGE = Path(__file__).resolve().parents[2] / "ros_bridge"
COLCON = shutil.which("colcon", path=str(Path(sys.executable).parent))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("rclpy") is None, reason="the ROS 2 wheels are not installed"
    ),
    pytest.mark.skipif(COLCON is None, reason="colcon is not installed"),
    pytest.mark.skipif(shutil.which("cmake") is None, reason="CMake is not installed"),
]

IMPORT = """
import application_manager_interfaces, demandops_interfaces
from application_manager_interfaces.action import DeploymentRequest
from demandops_interfaces.srv import GetBookkeeping
from rclpy.type_support import check_for_type_support

check_for_type_support(DeploymentRequest)
check_for_type_support(GetBookkeeping)
print(application_manager_interfaces.__file__)
print(demandops_interfaces.__file__)
"""


LOOK_UP = (
    sys.executable,
    "-c",
    """
import demandops, demandops_ros
from ament_index_python.packages import get_package_prefix, get_package_share_directory

print(demandops.__file__, demandops_ros.__file__, sep="\\n")
print(get_package_share_directory("demandops_ros"))
print(get_package_prefix("demandops_ros") + "/lib/demandops_ros/serve")
""",
)
SITE = Path("lib", f"python{sys.version_info[0]}.{sys.version_info[1]}", "site-packages")
SKELETON = ("skeleton", "state-repo-skeleton")


def files_of(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


def run(command: list[str], folder: Path) -> str:
    environ = {
        "AMENT_PREFIX_PATH": sys.prefix,
        "COLCON_HOME": str(folder / "colcon"),
        "HOME": str(folder),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    result = subprocess.run(
        command, cwd=folder, env=environ, capture_output=True, text=True, check=False, timeout=900
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def build(folder: Path) -> None:
    assert COLCON is not None
    prefix = f"-DCMAKE_PREFIX_PATH={sys.prefix}"
    python = f"-DPython3_EXECUTABLE={sys.executable}"
    run([COLCON, "build", "--cmake-args", prefix, python, "-DBUILD_TESTING=OFF"], folder)


def test_the_packages_build_with_colcon_and_import_from_its_install_space(tmp_path: Path) -> None:
    shutil.copytree(BRIDGE / "interfaces", tmp_path / "src")
    build(tmp_path)
    script = f". install/setup.sh && {shlex.join([sys.executable, '-c', IMPORT])}"
    places = run(["sh", "-c", script], tmp_path).splitlines()
    assert places == [
        str(tmp_path / "install" / package / SITE / package / "__init__.py")
        for package in ("application_manager_interfaces", "demandops_interfaces")
    ]
    # A colcon build includes the C++ headers, so a C++ node may use the interfaces too.
    header = Path("include", "demandops_interfaces", "demandops_interfaces", "srv")
    assert (
        tmp_path / "install" / "demandops_interfaces" / header / "get_bookkeeping.hpp"
    ).is_file()


def test_the_package_of_the_node_brings_its_code_its_data_and_its_launch_file(
    tmp_path: Path,
) -> None:
    tmp_path.joinpath("src").mkdir()
    tmp_path.joinpath("src", "demandops_ros").symlink_to(BRIDGE / "ros_package")
    build(tmp_path)
    installed = tmp_path / "install" / "demandops_ros"
    found = run(["sh", "-c", f". install/setup.sh && {shlex.join([*LOOK_UP])}"], tmp_path)
    assert found.splitlines() == [
        str(installed / SITE / "demandops" / "__init__.py"),
        str(installed / SITE / "demandops_ros" / "__init__.py"),
        str(installed / "share" / "demandops_ros"),
        str(installed / "lib" / "demandops_ros" / "serve"),
    ]
    data = installed / SITE / "demandops" / "_data"
    for name, folder in (("templates", "templates"), ("appdefs", "appdefs"), SKELETON):
        assert files_of(data / name) == files_of(BRIDGE.parent / folder)
    assert files_of(installed / "share" / "demandops_ros") >= {
        Path("launch/demandops.launch.xml"),
        Path("config/params.yaml"),
    }
    served = run(["sh", "-c", f". install/setup.sh && {found.splitlines()[-1]} --help"], tmp_path)
    assert served.startswith("Usage: demandops serve [OPTIONS]")
