"""The interface packages build in a colcon workspace, as they do in a ROS 2 installation.

Here the workspace lies over the wheels of PyPI, which colcon takes for an underlay.
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

INTERFACES = Path(__file__).resolve().parents[2] / "ros_bridge" / "interfaces"
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


def run(command: list[str], folder: Path) -> str:
    environ = {
        "AMENT_PREFIX_PATH": sys.prefix,
        "COLCON_HOME": str(folder / "colcon"),
        "HOME": str(folder),
        "PATH": os.environ["PATH"],
    }
    result = subprocess.run(
        command, cwd=folder, env=environ, capture_output=True, text=True, check=False, timeout=900
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_the_packages_build_with_colcon_and_import_from_its_install_space(tmp_path: Path) -> None:
    shutil.copytree(INTERFACES, tmp_path / "src")
    assert COLCON is not None
    prefix = f"-DCMAKE_PREFIX_PATH={sys.prefix}"
    python = f"-DPython3_EXECUTABLE={sys.executable}"
    run([COLCON, "build", "--cmake-args", prefix, python, "-DBUILD_TESTING=OFF"], tmp_path)
    script = f". install/setup.sh && {shlex.join([sys.executable, '-c', IMPORT])}"
    places = run(["sh", "-c", script], tmp_path).splitlines()
    site = Path("lib", f"python{sys.version_info[0]}.{sys.version_info[1]}", "site-packages")
    assert places == [
        str(tmp_path / "install" / package / site / package / "__init__.py")
        for package in ("application_manager_interfaces", "demandops_interfaces")
    ]
    # Here nothing is left out: a C++ node may use the interfaces too.
    header = Path("include", "demandops_interfaces", "demandops_interfaces", "srv")
    assert (
        tmp_path / "install" / "demandops_interfaces" / header / "get_bookkeeping.hpp"
    ).is_file()
