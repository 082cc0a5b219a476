"""`make release` builds a wheel that works and has all data, and tells all changes."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import demandops
import pytest
import yaml

from tests.kit.cli import Ran, process
from tests.kit.repo import program

ROOT = Path(__file__).parents[2]
NAME = f"demandops-{demandops.__version__}"


def release(script: Path, *args: str) -> Ran:
    return process(script, *args, env=os.environ | {"PYTHON": sys.executable}, timeout=600)


def test_everything_has_the_same_version() -> None:
    chart = yaml.safe_load(ROOT.joinpath("deploy/chart/Chart.yaml").read_text())
    assert chart["version"] == chart["appVersion"] == demandops.__version__
    for path, line in {
        "ros_bridge/ros_package/package.xml": "<version>{}</version>",
        "ros_bridge/interfaces/demandops_interfaces/package.xml": "<version>{}</version>",
        "pyproject.toml": '\nversion = "{}"\n',
    }.items():
        assert line.format(demandops.__version__) in ROOT.joinpath(path).read_text(), path


def test_each_change_that_no_release_has_told_has_a_group() -> None:
    groups = "demand|applications|placement|policy|overrides|audit|page|operations|gone"
    readme = ROOT.joinpath("changelog.d/README.md").read_text()
    assert all(f"`{group}`" in readme for group in groups.split("|"))
    for path in ROOT.joinpath("changelog.d").iterdir():
        if path.name != "README.md":
            assert re.fullmatch(rf"[a-z0-9-]+\.({groups})\.md", path.name), path.name
            assert len(path.read_text().splitlines()) == 1, path.name


def test_no_release_leaves_a_change_untold(tmp_path: Path) -> None:
    for folder in ("deploy", "changelog.d"):
        (tmp_path / folder).mkdir()
    script = shutil.copy(ROOT / "deploy" / "release", tmp_path / "deploy")
    (tmp_path / "changelog.d" / "odd-names.audit.md").write_text("Odd names are refused.\n")
    version = demandops.__version__
    for section, told in (("0.0.1", f"no section '## {version}'"), (version, "odd-names.audit.md")):
        (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n## {section} (2026-11-21)\n")
        done = release(script)
        assert (done.code, done.out) == (1, ""), done
        assert told in done.err


@pytest.mark.slow
@pytest.mark.limit(600)
def test_a_release_is_built_and_tried_in_an_empty_environment(tmp_path: Path) -> None:
    done = release(ROOT / "deploy" / "release", str(tmp_path))
    assert done.code == 0, done.err
    assert "release: a state repo, a check of it, a demand\nrelease: ready: " in done.out
    assert zipfile.is_zipfile(tmp_path / f"{NAME}-py3-none-any.whl")
    with tarfile.open(tmp_path / f"{NAME}.tar.gz") as sdist:
        assert f"{NAME}/pyproject.toml" in sdist.getnames()
    with tarfile.open(tmp_path / f"{NAME}-docs.tar.gz") as docs:
        pages = {f"{NAME}-docs/{page}.html" for page in ("index", "generated/commands")}
        assert pages <= {*docs.getnames()}
    subprocess.run(["sha256sum", "--check", "--quiet", f"{NAME}.sha256"], cwd=tmp_path, check=True)


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
    packed = zipfile.ZipFile(wheel)
    names = set(packed.namelist())
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
    # the pipelines of a state repo give pip this file (tests/integration/test_pipelines.py)
    (name,) = [name for name in names if name.endswith("constraints.txt")]
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
    for name in ("detect", "parameter_sync", "serve"):
        assert os.access(tmp_path / "lib" / "demandops_ros" / name, os.X_OK)


STAND_INS = {
    "debootstrap": 'echo "$@" >"$CALLED"; mkdir -p "$3/etc/apt"',
    "buildah": """case "$*" in *mount*) mkdir -p "$ROOT/bin"; echo "$ROOT" ;; esac""",
    "apt-get": """test "$1" = indextargets; [ ! -e "$SOURCES" ] || cat "$SOURCES" """,
}
MIRROR = "http://mirror.invalid"


def test_an_image_has_the_release_and_the_sources_of_the_machine(tmp_path: Path) -> None:
    root, called, sources = (tmp_path / name for name in ("root", "called", "sources"))
    for name, text in STAND_INS.items():
        program(tmp_path / name, text)
    env = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    env |= {"SOURCES": str(sources), "CALLED": str(called), "ROOT": str(root)}
    command = ["sh", str(ROOT / "deploy" / "image"), str(tmp_path / "image")]
    name = platform.freedesktop_os_release()["VERSION_CODENAME"]
    done = process(*command, env=env)
    assert (done.code, called.exists()) == (1, False)
    assert f"apt has no source of {name}" in done.err
    parts = ("-security {}/security main", " {}/packages main", " {}/packages contrib")
    lines = [f"{name}{part.format(MIRROR)}\n" for part in parts]
    sources.write_text("".join(lines) + f"other {MIRROR}/other main\n")
    done = process(*command, env=env)
    assert done.code == 0, done.err
    assert called.read_text() == f"--variant=minbase {name} {root} {MIRROR}/packages\n"
    assert (root / "etc/apt/sources.list").read_text().splitlines() == [
        f"deb {MIRROR}/packages {name} contrib",
        f"deb {MIRROR}/packages {name} main",
        f"deb {MIRROR}/security {name}-security main",
    ]
