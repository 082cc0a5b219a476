"""The wheel has all data of the program, if it is built from what deploy/Containerfile copies.

``test_release.py`` shows that it renders demands without a checkout.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
CONTAINER_FILE = ROOT / "deploy" / "Containerfile"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    sources = folder / "sources"  # setuptools would leave its build folder in the checkout
    sources.mkdir()
    for line in CONTAINER_FILE.read_text().splitlines():
        command, *names = line.split() or [""]
        for name in names[:-1] if command == "COPY" else ():
            (sources / name).parent.mkdir(exist_ok=True)
            if (ROOT / name).is_dir():
                skipped = shutil.ignore_patterns("__pycache__", "*.egg-info")
                shutil.copytree(ROOT / name, sources / name, ignore=skipped)
            else:
                shutil.copy(ROOT / name, sources / name)
    options = ["-q", "--no-deps", "-w", str(folder)]
    command = [sys.executable, "-m", "pip", "wheel", *options, str(sources)]
    subprocess.run(command, check=True)
    return next(folder.glob("demandops-*.whl"))


def test_the_wheel_carries_all_data_files_and_no_others(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, prefix in (
        ("templates", "demandops/_data/templates/"),
        ("appdefs", "demandops/_data/appdefs/"),
        ("state-repo-skeleton", "demandops/_data/skeleton/"),
        ("generator/demandops/web/pages", "demandops/web/pages/"),
        ("generator/demandops/web/static", "demandops/web/static/"),
    ):
        top = ROOT / folder
        files = {path.relative_to(top).as_posix() for path in top.rglob("*") if path.is_file()}
        assert {n.removeprefix(prefix) for n in names if n.startswith(prefix)} == files
    assert not [name for name in names if name.startswith(("tests/", "examples/", "docs/"))]


def test_the_wheel_installs_the_versions_that_it_was_tested_with(wheel: Path) -> None:
    """The pipelines of a state repo give pip this file (tests/integration/test_pipelines.py)."""
    packed = zipfile.ZipFile(wheel)
    (name,) = [name for name in packed.namelist() if name.endswith("constraints.txt")]
    assert name.partition(".data/")[2] == "data/share/demandops/constraints.txt"
    assert packed.read(name) == (ROOT / "constraints.txt").read_bytes()


def test_ros_finds_its_package_below_the_prefix_of_the_wheel(wheel: Path, tmp_path: Path) -> None:
    """PyPI has neither `ros2 run` nor `ros2 launch`, so the test only looks up what they need."""
    packages = pytest.importorskip("ament_index_python.packages")
    # without --ignore-installed pip would remove the package under test from its environment
    options = ["-q", "--no-deps", "--no-index", "--ignore-installed", "--prefix", str(tmp_path)]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(wheel)], check=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
        assert packages.get_package_prefix("demandops_ros") == str(tmp_path)
        share = Path(packages.get_package_share_directory("demandops_ros"))
    assert {path.relative_to(share).as_posix() for path in share.rglob("*.*")} == {
        "package.xml",
        "config/detector_params.yaml",
        "config/params.yaml",
        "launch/demandops.launch.xml",
        "launch/detector.launch.xml",
        "launch/parameter_sync.launch.xml",
    }
    for program in ("detect", "parameter_sync", "serve"):
        assert os.access(tmp_path / "lib" / "demandops_ros" / program, os.X_OK)
