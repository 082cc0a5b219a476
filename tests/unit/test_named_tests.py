"""Each test and each function of the flow that the documentation names exists."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from operator import attrgetter
from pathlib import Path

import pytest

from tests.integration.repo.test_stories import STORIES
from tests.scenarios import running

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
    assert {case for _, _, case in named} - {""} <= {*running.scenarios(), *STORIES}


def test_each_function_on_the_path_of_a_demand_exists() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    path = re.findall(r"^\|[^|]*\| `([\w.]+)` \| `([\w.]+)` \|", page, re.MULTILINE)
    assert len(path) > 30
    for function, module in path:
        assert callable(attrgetter(function)(import_module(module)))
