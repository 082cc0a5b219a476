"""A test runs each command of the documentation, or a comment above the command says why not."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest

from tests.docs import pages
from tests.kit.repo import git

ROOT = Path(__file__).parents[2]
OTHERS = ("docs/decisions/", "tests/", "state-repo-skeleton/", "CHANGELOG", "changelog.d/")
LIST = ("ls-files", "--cached", "--others", "--exclude-standard", "--", "*.md")
PAGES = [page for page in git(ROOT, *LIST).split() if not page.startswith(OTHERS)]
BLOCKS = {page: list(pages.blocks(ROOT.joinpath(page).read_text())) for page in PAGES}
RUN = [page for page, found in BLOCKS.items() if any(block.tag == "run" for block in found)]


@pytest.mark.parametrize("page", RUN)
def test_the_commands_of_a_page_do_what_it_says(page: str, tmp_path: Path) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    environment = {
        "COLUMNS": "200",
        "HOME": str(tmp_path / "home"),
        "LANG": "C.UTF-8",
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PWD": str(tmp_path),
    }
    (tmp_path / "home").mkdir()
    pages.run(ROOT.joinpath(page).read_text(), tmp_path, environment)


@pytest.mark.parametrize("page", PAGES)
def test_commands_say_what_runs_them(page: str) -> None:
    untold = [block for block in BLOCKS[page] if block.has_commands and not block.tag]
    assert [f"{page}:{block.line}: {block.text.splitlines()[0]}" for block in untold] == [], (
        "put <!-- run -->, <!-- tested by tests/… --> or <!-- not run: WHY --> before the block "
        "(tests/docs/pages.py)"
    )
    for block in BLOCKS[page]:
        for path in re.findall(r"tests/[\w/.]*\w", block.tag):
            assert ROOT.joinpath(path).exists(), f"{page}:{block.line}: there is no {path}"


@pytest.mark.parametrize("page", PAGES)
def test_a_file_has_its_path_above_it_because_forges_show_no_title(page: str) -> None:
    text = ROOT.joinpath(page).read_text()
    untold = [
        title
        for title in re.findall(r"^```\w* title=\"([^\"]*)\"", text, re.MULTILINE)
        if not re.search(rf"^`{re.escape(title)}`:\n\n```\w* title=", text, re.MULTILINE)
    ]
    assert untold == [], "put the path as `PATH`: above the block"
