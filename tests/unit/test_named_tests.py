"""Every test that the documentation names exists, and a make target runs every test file."""

from __future__ import annotations

import ast
import os
import re
import shlex
import subprocess
from functools import lru_cache
from importlib import import_module
from operator import attrgetter
from pathlib import Path

import pytest

from tests.integration import test_stories
from tests.integration.repo.test_stories import STORIES
from tests.scenarios import running
from tests.simulation.faults import FAULTS

ROOT = Path(__file__).parents[2]
NAMED = re.compile(r"`(tests/[\w/]+\.py)::([\w:]+)(?:\[([^\]`]+)\])?`")


def names_in(file: Path) -> set[str]:
    """Return the names of the tests in a file; a method is ``Class::function``."""
    found = set[str]()
    for node in ast.parse(file.read_text()).body:
        for each in node.body if isinstance(node, ast.ClassDef) else ():
            if isinstance(each, ast.FunctionDef):
                found.add(f"{node.name}::{each.name}")
        if isinstance(node, ast.FunctionDef):
            found.add(node.name)
    return found


@pytest.mark.parametrize("page", ["reliability", "threat-model"])
def test_a_test_that_a_page_names_exists(page: str) -> None:
    named = NAMED.findall((ROOT / "docs" / f"{page}.md").read_text())
    assert len(named) > 20
    missing = [name for file, name, _ in named if name not in names_in(ROOT / file)]
    assert missing == []
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
