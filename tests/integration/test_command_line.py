"""The command line: text, JSON and exit codes of every command.

Exit codes: 0 done, 1 a fault that the user can fix, 2 wrong usage, 3 a fault of the program.
More is in ``stories``; what commands print on a terminal is in ``tests/terminal/expected``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pygit2
import pytest
import yaml
from demandops.base.errors import Unsound
from demandops.cli.queries import commits

from tests.integration.conftest import On
from tests.kit.cli import Ran, Run
from tests.kit.goals import (
    APP,
    CLOUD,
    Goal,
    application,
    connection,
    goal,
    perception,
)
from tests.kit.repo import FORGER, GitRepo, git

FUSION = "of-edge-object-detection-fusion-cf7e0180a8bb"
URL = "https://git.example/own.git"
REQUEST_KEYS = ["index", "request", "outcome", "commit", "faults", "warnings", "not_held", "placed"]
GIVEN = yaml.safe_dump(perception())


def text(*goals: Goal) -> str:
    return yaml.safe_dump_all(goals, sort_keys=False)


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


@pytest.fixture
def joined(on: On, state: GitRepo) -> GitRepo:
    """A state repo in which ``perception()`` is booked."""
    assert on.request(perception()).code == 0
    return state


class TestInit:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        return tmp_path / "state"

    def test_a_bare_state_repo(self, demandops: Run, folder: Path) -> None:
        ran = demandops("init", folder / "state.git", "--bare")
        assert (ran.code, ran.err) == (0, "")
        repo = pygit2.Repository(str(folder / "state.git"))
        assert (repo.is_bare, repo.references["HEAD"].target) == (True, "refs/heads/main")
        assert str(repo.references["refs/heads/main"].target)[:10] in ran.out
        assert demandops("bookkeeping", "--state-repo", folder / "state.git").code == 0

    def test_a_state_repo_to_edit(self, demandops: Run, folder: Path) -> None:
        found = demandops("init", folder, "--output", "json").json()
        assert found.pop("commit") == git(folder, "rev-parse", "main")
        assert found == {"directory": str(folder), "gitops": "flux", "bare": False}
        assert not git(folder, "status", "--porcelain")
        assert demandops("check", folder).code == 0
        assert not (folder / "bootstrap").exists(), "no cluster can follow it without a URL"
        root = folder / "demandops.yaml"
        root.write_text(root.read_text().replace("# url: https://git.example", f"url: {URL}#"))
        assert "write  bootstrap/c-its.yaml" in demandops("check", folder).out

    @pytest.mark.parametrize("gitops", ["flux", "argocd"])
    def test_an_empty_fleet(self, demandops: Run, folder: Path, gitops: str) -> None:
        options = ["--url", URL, "--gitops", gitops, "--example", "none"]
        assert demandops("init", folder, *options).code == 0
        ran = demandops("check", folder)
        assert (ran.code, ran.err) == (0, "")
        assert [path.name for path in (folder / "appdefs").iterdir()] == ["charts"]
        for path in (folder / "inventory").iterdir():
            assert not read(path)[path.stem]
        for path in (*(folder / "policy").iterdir(), *(folder / "registry").iterdir()):
            assert "perception" not in path.read_text().replace("collective", "")
        assert list(read(folder / "registry" / "images.yaml")["images"]) == ["mqtt-client"]

    def test_an_empty_working_directory_is_used(
        self, demandops: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (folder / "inner").mkdir(parents=True)
        monkeypatch.chdir(folder)
        assert demandops("init", "inner/..").code == 1
        monkeypatch.chdir(folder / "inner")
        assert demandops("init", ".").code == 0
        assert (folder / "inner" / "demandops.yaml").is_file()


class TestRequest:
    def test_json_and_text_tell_the_outcome_of_each(
        self, on: On, demandops: Run, state: GitRepo, tmp_path: Path
    ) -> None:
        # no broker is at either end, so no connection can be derived
        app = application(node="vehicle01")
        asked = goal([app, application("other")], id="r", shutdown=True)
        goals = goal([app], id="r"), goal([application(node="egde")], id="s"), asked
        git(tmp_path, "clone", "-q", "--bare", str(state.path), "other.git")
        other = GitRepo(tmp_path / "other.git")
        before, given = state.tip, text(*goals)
        line = given[: given.index("egde")].count("\n") + 1
        ran = on.request(*goals)
        assert (ran.code, ran.err) == (1, "")
        booked, refused, released = ran.json()
        assert list(booked) == list(refused) == REQUEST_KEYS
        first = git(state, "rev-parse", "main~1")
        assert git(state, "rev-parse", "main~2") == before
        assert (booked["index"], booked["request"], booked["commit"]) == (0, "r", first)
        (warning,) = booked["warnings"]
        assert warning.startswith(f"application '{APP}': no connection carries {CLOUD[0]} ")
        assert (refused["outcome"], refused["commit"]) == ("refused", None)
        (fault,) = refused["faults"]
        message = fault.pop("message")
        place = {"file": "", "field": "apps[0].header.node_id", "line": line}
        assert fault == {"code": "unknown-node"} | place
        assert (released["outcome"], released["commit"]) == ("released", state.tip)
        assert released["not_held"] == ["application 'other' for vehicle00"]

        ran = demandops("request", "-", "--state-repo", other.path, stdin=given)
        log = git(other, "rev-list", "main").split()
        assert ran.out.splitlines() == [
            f"standard input: request 0 'r' booked in {log[1]}",
            f"standard input: request 2 'r' released in {log[0]}",
        ]
        assert ran.err.splitlines() == [
            f"  warning: {warning}",
            "standard input: request 1 's' refused",
            f"  line {line}: apps[0].header.node_id: {message}",
            f"  listed, but not held by the requester: {released['not_held'][0]}",
        ]

    def test_files_and_documents_are_taken_in_order(
        self, on: On, state: GitRepo, tmp_path: Path
    ) -> None:
        for name in "ab":
            documents = (goal([], [connection(name)], id=f"{name}{number}") for number in (1, 2))
            (tmp_path / f"{name}.yaml").write_text(text(*documents))
        empty = f"---\n---\n{text(goal([], [connection('c')], id='c1'))}\n---\n# nothing\n---\n"
        files = tmp_path / "b.yaml", "-", tmp_path / "a.yaml"
        rows = on("request", *files, "--output", "json", stdin=empty).json()
        assert [row["request"] for row in rows] == ["b1", "b2", "c1", "a1", "a2"]
        assert [row["index"] for row in rows] == [0, 1, 2, 3, 4]
        log = git(state, "rev-list", "--reverse", "main~5..main").split()
        assert [row["commit"] for row in rows] == log
        bad = tmp_path / "bad.yaml"
        bad.write_text(f"{GIVEN}---\nid: [\n")
        ran = on("request", tmp_path / "a.yaml", bad, "--output", "json")
        (fault,) = ran.json()["faults"]
        assert (ran.code, fault["file"], state.tip) == (1, str(bad), log[-1])

    def test_a_command_that_fails_prints_its_faults_as_json(
        self, demandops: Run, tmp_path: Path
    ) -> None:
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

    def test_a_dry_run_shows_the_consequence_and_books_nothing(
        self, on: On, state: GitRepo, data_home: Path
    ) -> None:
        before = state.tip
        ran = on("request", "-", "--dry-run", stdin=GIVEN)
        assert (ran.code, ran.err, state.tip) == (0, "", before)
        assert not list(data_home.rglob("outbox.jsonl"))
        lines = ran.out.splitlines()
        assert "  + od-edge-vehicle00 (object-detection on edge for vehicle00)" in lines
        assert f"  + {FUSION} (object-fusion on edge for {APP})" in lines
        paths = [line.split()[-1] for line in lines if line.startswith("  write ")]
        assert on("request", "-", stdin=GIVEN).code == 0
        assert paths == git(state, "diff", "--name-only", "main~1", "main").splitlines()


class TestVerify:
    def test_what_was_tampered_with_does_not_hold(self, on: On, joined: GitRepo) -> None:
        (path,) = (path for path in joined.manifests() if "/od-" in path)
        changed = {path: joined.files()[path] + "# changed\n"}
        joined.commit(changed, "Forged\n\nOperation: join\nRender-Version: 3\n", FORGER)
        ran = on("verify")
        assert ran.code == 1
        assert ran.out.splitlines() == [
            f"{joined.tip[:10]} DIFFERS  Forged",
            f"    {path}",
            "0 of 1 commits are verified",
        ]
        (row,) = on("verify", "--output", "json").json()
        assert row == {
            "commit": joined.tip, "summary": "Forged", "holds": False, "skipped": None,
            "faults": [], "differing": [path], "touched": [],
            "signed": False, "signer": None, "signature": None,
        }  # fmt: skip


class TestStateRepo:
    def refused(self, demandops: Run, command: str, where: str | Path) -> str:
        ran: Ran = demandops(*command.split(), "--state-repo", where, stdin=GIVEN)
        assert (ran.code, ran.out) == (1, "")
        return ran.err

    @pytest.mark.parametrize("command", ["bookkeeping", "request -"])
    def test_a_password_in_its_address_is_refused_and_not_shown(
        self, demandops: Run, data_home: Path, command: str
    ) -> None:
        url = "https://somebody:hunter2@127.0.0.1:1/x.git?hunter2"
        told = self.refused(demandops, f"-v {command}", url)
        assert "holds a password or token" in told and "hunter2" not in told
        for path in data_home.rglob("*"):
            assert "hunter2" not in path.name
            assert not path.is_file() or "hunter2" not in path.read_text()

    def test_a_newer_generators_state_repo_is_refused(self, demandops: Run, state: GitRepo) -> None:
        root = state.files()["demandops.yaml"].replace("renderVersion: 3", "renderVersion: 99")
        newer = ("DemandOps generator", "generator@demandops.invalid", 1_770_000_000)
        before = state.commit({"demandops.yaml": root}, "Newer\n\nRender-Version: 99\n", newer)
        assert "update the generator" in self.refused(demandops, "request -", state.path)
        assert state.tip == before

    def test_a_data_folder_that_cannot_be_made_is_the_users_to_mend(
        self, demandops: Run, state: GitRepo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("DEMANDOPS_DATA_HOME", str(tmp_path / "file" / "home"))
        assert str(tmp_path / "file") in self.refused(demandops, "request -", state.path)


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

    def run(self, *args: str, stdin: str = "", **environment: str) -> Ran:
        done = subprocess.run(
            [sys.executable, "-m", "demandops.cli.main", *args],
            input=stdin, env=os.environ | environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        return Ran(done.returncode, done.stdout, done.stderr)

    def test_it_ends_with_the_code(self, bare: Path) -> None:
        given = text(perception(id="1"), goal(id="2"))
        ran = self.run("request", "-", "-o", "json", "--state-repo", str(bare), stdin=given)
        assert (ran.code, ran.err) == (1, "")
        assert [row["outcome"] for row in json.loads(ran.out)] == ["booked", "refused"]

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
