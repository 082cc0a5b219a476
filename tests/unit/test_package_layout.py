"""The layout of the packages: module names, sizes of folders, and the list in `pyproject.toml`."""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from demandops.cli import main

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
    """The import contract `door-runtime` cannot check this, because it must allow `datetime`."""
    uses = re.compile(r"\b(datetime|date)\.(now|utcnow|today)\(|PoolExecutor\b|\burandom\(")
    assert [dotted(path) for path in MODULES if uses.search(path.read_text())] == [
        "demandops.base.runtime.py"
    ]


def test_a_folder_has_at_most_twelve_modules() -> None:
    count: defaultdict[str, int] = defaultdict(int)
    for path in MODULES:
        count[dotted(path.parent)] += path.stem != "__init__"
    assert {name: number for name, number in count.items() if number > MOST_MODULES} == {}
