"""The command line: text, JSON and exit codes of every command.

Exit codes: 0 done, 1 a fault that the user can fix, 2 wrong usage, 3 a fault of the program.
More is in ``stories``; what commands print on a terminal is in ``tests/terminal/expected``.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pygit2
import pytest
import yaml
from demandops.base.errors import Unsound
from demandops.cli.queries import commits

from tests.integration.conftest import On
from tests.kit.cli import Ran, Run
from tests.kit.goals import perception
from tests.kit.repo import FORGER, GitRepo, git

GIVEN = yaml.safe_dump(perception())


def test_init_makes_a_bare_repo_or_fills_an_empty_working_directory(
    demandops: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran = demandops("init", tmp_path / "state.git", "--bare")
    assert (ran.code, ran.err) == (0, "")
    repo = pygit2.Repository(str(tmp_path / "state.git"))
    assert (repo.is_bare, repo.references["HEAD"].target) == (True, "refs/heads/main")
    assert str(repo.references["refs/heads/main"].target)[:10] in ran.out
    (tmp_path / "outer" / "inner").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "outer")
    assert demandops("init", "inner/..").code == 1
    monkeypatch.chdir(tmp_path / "outer" / "inner")
    assert demandops("init", ".").code == 0
    assert not git(".", "status", "--porcelain")


def test_a_command_that_fails_prints_its_faults_as_json(demandops: Run, tmp_path: Path) -> None:
    for command in (
        "bookkeeping", "decommission n", "diff a b", "get overrides", "get proposals", "log",
        "rollback r -m why", "status", "upgrade", "verify", "why n",
    ):  # fmt: skip
        where = (*command.split(), "--state-repo", tmp_path / "none")
        told, text = demandops(*where, "-o", "json"), demandops(*where)
        (fault,) = told.json()["faults"]
        assert (told.code, text.code, text.out) == (1, 1, "")
        assert list(fault) == ["code", "field", "message", "file", "line"]
        assert told.err == text.err == f"error: {fault['message']}\n"


class TestVerify:
    def test_what_was_tampered_with_does_not_hold(self, on: On, state: GitRepo) -> None:
        on.book(perception())
        (path,) = (path for path in state.manifests() if "/od-" in path)
        changed = {path: state.files()[path] + "# changed\n"}
        state.commit(changed, "Forged\n\nOperation: join\nRender-Version: 3\n", FORGER)
        ran = on("verify")
        assert ran.code == 1
        assert ran.out.splitlines() == [
            f"{state.tip[:10]} DIFFERS  Forged",
            f"    {path}",
            "0 of 1 commits are verified",
        ]
        (row,) = on("verify", "--output", "json").json()
        assert row == {
            "commit": state.tip, "summary": "Forged", "holds": False, "skipped": None,
            "faults": [], "differing": [path], "touched": [],
            "signed": False, "signer": None, "signature": None,
        }  # fmt: skip


@pytest.mark.parametrize("command", ["bookkeeping", "request -"])
def test_a_password_in_an_address_is_refused_and_not_shown(
    demandops: Run, data_home: Path, command: str
) -> None:
    url = "https://somebody:hunter2@127.0.0.1:1/x.git?hunter2"
    ran = demandops("-v", *command.split(), "--state-repo", url, stdin=GIVEN)
    assert (ran.code, ran.out) == (1, "")
    assert "holds a password or token" in ran.err and "hunter2" not in ran.err
    files = [path for path in data_home.rglob("*") if path.is_file()]
    assert not [path for path in files if "hunter2" in f"{path} {path.read_text()}"]


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


class TestProcess:
    """The command as a process of its own."""

    def run(self, *args: str, **environment: str) -> Ran:
        command, env = [sys.executable, "-m", "demandops.cli.main", *args], os.environ | environment
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        return Ran(done.returncode, done.stdout, done.stderr)

    def test_in_a_hook_it_works_on_the_state_repo_and_not_on_the_hooks_repo(
        self, bare: Path, tmp_path: Path
    ) -> None:
        git(tmp_path, "init", "--quiet", "other")
        config = tmp_path / "other" / ".git" / "config"
        before = config.read_text()
        of_hook = {"GIT_INDEX_FILE": "index", "GIT_QUARANTINE_PATH": "x"}
        where = ("--state-repo", bare.as_uri())
        ran = self.run("get", "nodes", *where, GIT_DIR=str(config.parent), **of_hook)
        assert (ran.code, ran.out[:4]) == (0, "NODE"), ran.err
        assert config.read_text() == before

    def test_a_machine_without_git_is_told_what_to_install(
        self, bare: Path, tmp_path: Path
    ) -> None:
        ran = self.run("get", "nodes", "--state-repo", str(bare), PATH=str(tmp_path))
        assert ran.code == 1
        assert ran.err.startswith("error: get needs git, which is not installed; install it")


def test_a_clone_has_the_state_repos_kind_of_ids_whatever_the_users_default_is(
    bare: Path, monkeypatch: pytest.MonkeyPatch, demandops: Run
) -> None:
    monkeypatch.setenv("GIT_DEFAULT_HASH", "sha256")
    assert demandops("get", "nodes", "--state-repo", bare.as_uri()).code == 0
