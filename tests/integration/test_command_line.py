"""The command line: text, JSON and exit codes of every command.

Exit codes: 0 done, 1 a fault that the user can fix, 2 wrong usage, 3 a fault of the program.
More is in ``stories``; what commands print on a terminal is in ``tests/terminal/expected``.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from demandops.base.errors import Unsound
from demandops.cli.queries import commits

from tests.integration.conftest import On
from tests.kit.cli import PROGRAM, Ran, process
from tests.kit.repo import git


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (RuntimeError("boom"), "error: a fault of demandops itself: RuntimeError: boom\nplease"),
        (Unsound("the disk fails"), "error: the disk fails\n"),
    ],
)
def test_a_fault_of_the_program_or_its_machine_has_a_code_of_its_own(
    on: On, monkeypatch: pytest.MonkeyPatch, error: Exception, told: str
) -> None:
    def broken(*args: object) -> None:
        raise error

    monkeypatch.setattr(commits, "derive", broken)
    ran = on("bookkeeping")
    assert (ran.code, ran.out) == (3, "")
    assert ran.err.startswith(told)


def in_process(*args: str, **environment: str) -> Ran:
    return process(*PROGRAM, *args, env=os.environ | environment)


def test_in_a_hook_it_works_on_the_state_repo_and_not_on_the_hooks_repo(
    bare: Path, tmp_path: Path
) -> None:
    git(tmp_path, "init", "--quiet", "other")
    config = tmp_path / "other" / ".git" / "config"
    before = config.read_text()
    of_hook = {"GIT_INDEX_FILE": "index", "GIT_QUARANTINE_PATH": "x"}
    where = ("--state-repo", bare.as_uri())
    ran = in_process("get", "nodes", *where, GIT_DIR=str(config.parent), **of_hook)
    assert (ran.code, ran.out[:4]) == (0, "NODE"), ran.err
    assert config.read_text() == before


def test_a_machine_without_git_is_told_what_to_install(bare: Path, tmp_path: Path) -> None:
    ran = in_process("get", "nodes", "--state-repo", str(bare), PATH=str(tmp_path))
    assert ran.code == 1
    assert ran.err.startswith("error: get needs git, which is not installed; install it")
