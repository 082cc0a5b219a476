"""Each test that the documentation names exists."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

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
    assert {scenario for _, _, scenario in named} - {""} <= set(running.scenarios())
