"""The layout of the packages, the launch files of ROS, which no test here can run, and the tests.

Every test that the documentation names exists, and a make target runs every test file.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections import defaultdict
from functools import lru_cache
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import demandops
import demandops_ros
import pytest
import yaml
from demandops.cli import main

from tests.integration import test_stories
from tests.integration.repo.test_stories import STORIES
from tests.kit.limits import PATIENCE_S
from tests.scenarios import running
from tests.simulation.faults import FAULTS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
PACKAGES = (ROOT / "generator" / "demandops", ROOT / "ros_bridge" / "demandops_ros")
MODULES = sorted(path for package in PACKAGES for path in package.rglob("*.py"))
MOST_MODULES = 12

COMMANDS = PACKAGES[0] / "cli"


def dotted(path: Path) -> str:
    (source,) = (package.parent for package in PACKAGES if path.is_relative_to(package))
    return ".".join(path.relative_to(source).parts)


def setuptools() -> dict[str, Any]:
    return dict(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"])


def test_the_wheel_has_every_package() -> None:
    packages = {dotted(path.parent) for path in MODULES if path.name == "__init__.py"}
    assert packages == {dotted(path.parent) for path in MODULES}
    folders, listed = setuptools()["package-dir"], setuptools()["packages"]
    assert sorted(listed) == sorted(packages | {name for name in folders if "._data." in name})
    assert [folder for folder in folders.values() if not (ROOT / folder).is_dir()] == []


def test_a_module_name_occurs_once() -> None:
    """A command may have the name of a module elsewhere."""
    by_name: defaultdict[str, list[str]] = defaultdict(list)
    for path in MODULES:
        is_command = path.is_relative_to(COMMANDS) and path.stem in main.COMMANDS
        if path.stem != "__init__" and not is_command:
            by_name[path.stem].append(dotted(path))
    assert {name: paths for name, paths in by_name.items() if len(paths) > 1} == {}


def test_only_the_runtime_reads_a_clock_or_starts_threads() -> None:
    """The import contract of the doors cannot check this, because it must allow `datetime`."""
    uses = re.compile(r"\b(datetime|date)\.(now|utcnow|today)\(|PoolExecutor\b|\burandom\(")
    assert [dotted(path) for path in MODULES if uses.search(path.read_text())] == [
        "demandops.base.runtime.py"
    ]


def test_a_folder_has_at_most_twelve_modules() -> None:
    count: defaultdict[str, int] = defaultdict(int)
    for path in MODULES:
        count[dotted(path.parent)] += path.stem != "__init__"
    assert {name: number for name, number in count.items() if number > MOST_MODULES} == {}


PACKAGE = ROOT / "ros_bridge" / "ros_package"


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
    node = pytest.importorskip("demandops_ros.node_parameters").PARAMETERS
    detector = pytest.importorskip("demandops_ros.detector.detector_node").PARAMETERS
    of_node = (node, {"state_repo", "fetch_interval", "log_level"})
    of_detector = (detector, {"rules", "log_level"})
    for file, (defaults, left_out) in {"params": of_node, "detector_params": of_detector}.items():
        data: dict[str, Any] = yaml.safe_load((PACKAGE / "config" / f"{file}.yaml").read_text())
        named = data["/**"]["ros__parameters"]
        assert named == {name: defaults[name].default for name in defaults.keys() - left_out}


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


IMPORT = """
import sys
import demandops_ros
assert "rclpy" not in sys.modules, "the import alone loads rclpy"
from demandops_ros import DemandClient
assert DemandClient.__module__ == "demandops_ros.client"
assert "rclpy" in sys.modules
"""


def test_only_using_the_client_imports_rclpy() -> None:
    subprocess.run([sys.executable, "-c", IMPORT], check=True, timeout=PATIENCE_S)


def test_every_public_name_can_be_imported_and_no_other() -> None:
    assert set(demandops_ros.__all__) <= set(dir(demandops_ros))
    assert all(hasattr(demandops_ros, name) for name in demandops_ros.__all__)
    with pytest.raises(AttributeError, match="module 'demandops_ros' has no attribute 'Client'"):
        demandops_ros.Client  # noqa: B018


def test_each_module_has_a_place_in_the_order_of_the_rooms() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    (layers,) = (each["layers"] for each in settings["contracts"] if each["id"] == "rooms")
    places = tuple(
        f"{place}." for layer in layers for place in layer.replace("|", ":").split(" : ")
    )
    modules = [dotted(path) for path in MODULES if path.stem != "__init__"]
    assert [module for module in modules if not module.startswith(places)] == []


def test_the_process_with_limits_starts_without_what_is_slow_or_to_be_kept() -> None:
    loaded = "import demandops.templating.child, sys; print(*sys.modules)"
    command = [sys.executable, "-c", loaded]
    names = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    others = ("pydantic", "pygit2", "kubernetes", "demandops.model", "demandops.repo")
    assert {*others, "demandops.base.runtime"}.isdisjoint(names)


# ---- the tests ----


NAMED = re.compile(r"`(tests/[\w/]+\.py)::([\w:]+)(?:\[([^\]`]+)\])?`")


@pytest.mark.parametrize("page", ["reliability", "threat-model"])
def test_a_test_that_a_page_names_exists(page: str) -> None:
    named = NAMED.findall((ROOT / "docs" / f"{page}.md").read_text())
    assert len(named) > 20
    for file, name, _ in named:  # of a method, also its class
        text = (ROOT / file).read_text()
        assert all(re.search(rf"(def|class) {part}\b", text) for part in name.split("::")), name
    assert {case for _, _, case in named} - {""} <= {
        *running.scenarios(),
        *STORIES,
        *test_stories.STORIES,
        *FAULTS,
    }


def test_each_function_on_the_path_of_a_demand_exists() -> None:
    page = (ROOT / "ARCHITECTURE.md").read_text()
    path = re.findall(r"^\|[^|]*\| `([\w.]+)` \| `([\w.]+)` \|", page, re.MULTILINE)
    assert len(path) > 30
    for function, module in path:
        assert callable(attrgetter(function)(import_module(module)))


TEST_FILES = sorted((ROOT / "tests").rglob("test_*.py"))
PROCESSES = ("test-processes", "test-packages", "page", "docs", "simulate", "faults")
TARGETS = ("test", *PROCESSES, "e2e")  # e2e-argocd runs the files of e2e, by another marker


@lru_cache
def files_run_by(target: str) -> frozenset[Path]:
    environment = {name: value for name, value in os.environ.items() if "MAKE" not in name}
    printed = subprocess.run(
        ["make", "--dry-run", "--no-print-directory", target],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.replace("\\\n", " ")
    (call,) = [line for line in printed.splitlines() if " -m pytest " in line]
    words = shlex.split(call.replace("--ignore ", "--ignore="))
    ignored = [ROOT / word.removeprefix("--ignore=") for word in words if "--ignore=" in word]
    named = [ROOT / word for word in words if word.startswith("tests")]
    assert all(path.exists() for path in (*named, *ignored))
    return frozenset(
        file
        for file in TEST_FILES
        if any(file.is_relative_to(path) for path in named)
        and not any(file.is_relative_to(path) for path in ignored)
    )


def test_every_test_file_is_run() -> None:
    run = frozenset[Path]().union(*map(files_run_by, TARGETS))
    assert [str(file.relative_to(ROOT)) for file in TEST_FILES if file not in run] == []
