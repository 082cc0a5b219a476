"""The ROS packages build in a colcon workspace, as they do in a ROS 2 installation.

In the tests, the ROS 2 wheels of PyPI are the underlay of the workspace. These wheels lack ros2run
and ros2launch, so the tests launch nothing. They only check the files that both would look up.
"""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path

import pytest

from tests.kit.cli import process

BRIDGE = Path(__file__).resolve().parents[2] / "ros_bridge"
COLCON = shutil.which("colcon", path=str(Path(sys.executable).parent))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not COLCON or not shutil.which("cmake"), reason="needs colcon and CMake"),
]

LOOK_UP = """
import application_manager_interfaces, demandops, demandops_interfaces, demandops_ros
from ament_index_python.packages import get_package_prefix, get_package_share_directory
from application_manager_interfaces.action import DeploymentRequest
from demandops_interfaces.srv import GetBookkeeping
from rclpy.type_support import check_for_type_support

check_for_type_support(DeploymentRequest)
check_for_type_support(GetBookkeeping)
for module in (application_manager_interfaces, demandops, demandops_interfaces, demandops_ros):
    print(module.__file__)
print(get_package_share_directory("demandops_ros"))
print(get_package_prefix("demandops_ros"))
"""
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
    ran = process(*command, cwd=folder, env=environ, timeout=900)
    assert ran.code == 0, ran
    return ran.out


def test_the_packages_build_with_colcon_and_bring_code_data_and_launch_files(
    tmp_path: Path,
) -> None:
    shutil.copytree(BRIDGE / "interfaces", tmp_path / "src")
    tmp_path.joinpath("src", "demandops_ros").symlink_to(BRIDGE / "ros_package")
    assert COLCON is not None
    options = [f"-DCMAKE_PREFIX_PATH={sys.prefix}", f"-DPython3_EXECUTABLE={sys.executable}"]
    run([COLCON, "build", "--cmake-args", *options, "-DBUILD_TESTING=OFF"], tmp_path)

    def ran(*command: str) -> str:
        return run(["sh", "-c", f". install/setup.sh && {shlex.join(command)}"], tmp_path)

    install = tmp_path / "install"
    node = install / "demandops_ros"
    *modules, share, prefix = ran(sys.executable, "-c", LOOK_UP).splitlines()
    assert modules == [
        str(install / package / SITE / module / "__init__.py")
        for package, module in (
            ("application_manager_interfaces", "application_manager_interfaces"),
            ("demandops_ros", "demandops"),
            ("demandops_interfaces", "demandops_interfaces"),
            ("demandops_ros", "demandops_ros"),
        )
    ]
    assert (share, prefix) == (str(node / "share" / "demandops_ros"), str(node))
    # a colcon build includes the C++ headers, so a C++ node may use the interfaces too
    headers = Path("include", "demandops_interfaces", "demandops_interfaces", "srv")
    assert (install / "demandops_interfaces" / headers / "get_bookkeeping.hpp").is_file()
    data = node / SITE / "demandops" / "_data"
    for name, folder in (("templates", "templates"), ("appdefs", "appdefs"), SKELETON):
        assert files_of(data / name) == files_of(BRIDGE.parent / folder)
    launched = {Path("launch/demandops.launch.xml"), Path("config/params.yaml")}
    assert files_of(Path(share)) >= launched
    served = ran(str(node / "lib" / "demandops_ros" / "serve"), "--help")
    assert served.startswith("Usage: demandops serve [OPTIONS]")
