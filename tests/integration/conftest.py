"""The command line in this process, on bare state repos that are copies of one.

The builders of goals are those of ``tests/unit/demand/asking.py``.
"""

from __future__ import annotations

import io
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pygit2
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "unit" / "demand"))


@dataclass(frozen=True, slots=True)
class Ran:
    """What a command gave."""

    code: int
    out: str
    err: str

    def json(self) -> Any:
        """Return standard output as JSON; nothing else may stand there."""
        return json.loads(self.out)


Run = Callable[..., Ran]


@pytest.fixture
def data_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep outboxes and clones in a temporary folder."""
    home = tmp_path / "home"
    monkeypatch.setenv("DEMANDOPS_DATA_HOME", str(home))
    monkeypatch.delenv("DEMANDOPS_STATE_REPO", raising=False)
    return home


@pytest.fixture
def demandops(
    data_home: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Run:
    """Return a function that runs a command in this process, as ``demandops`` would."""
    from demandops.cli.main import run

    def call(*args: str | Path, stdin: str = "") -> Ran:
        capsys.readouterr()
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(stdin.encode()), "utf-8"))
        code = run([str(arg) for arg in args])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err, err
        return Ran(code, out, err)

    return call


@pytest.fixture(scope="session")
def laid_down(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bare state repo as ``demandops init`` makes it; copy it, never write to it."""
    from asking import NOW
    from demandops.staterepo import new_repo

    folder = tmp_path_factory.mktemp("laid-down") / "state.git"
    new_repo.init(folder, NOW, bare=True, gitops="flux")
    return folder


class StateRepo:
    """A bare state repo of one test, read with pygit2 and not with the program."""

    def __init__(self, path: Path) -> None:
        """Open it."""
        self.path = path

    @property
    def tip(self) -> str:
        """The newest commit."""
        return str(pygit2.Repository(str(self.path)).references["refs/heads/main"].target)

    def commits(self) -> list[str]:
        """Return the messages of all commits, newest first."""
        repo = pygit2.Repository(str(self.path))
        return [commit.message for commit in repo.walk(self.tip)]

    def files(self, under: str = "") -> dict[str, str]:
        """Return path → text of every file at the tip, below one folder or all."""
        repo = pygit2.Repository(str(self.path))
        found: dict[str, str] = {}

        def walk(tree: pygit2.Tree, prefix: str) -> None:
            for entry in tree:
                path = f"{prefix}{entry.name}"
                if isinstance(entry, pygit2.Tree):
                    walk(entry, f"{path}/")
                elif isinstance(entry, pygit2.Blob):
                    found[path] = entry.data.decode()

        walk(repo[self.tip].peel(pygit2.Tree), "")
        return {path: text for path, text in found.items() if path.startswith(under)}

    def manifests(self) -> dict[str, str]:
        """Return what a GitOps controller reads."""
        return {p: text for p, text in self.files("clusters/").items() if p.endswith(".yaml")}

    def commit(self, changed: dict[str, str | None], text: str = "By hand\n") -> str:
        """Commit as a person would, and return the commit."""
        from demandops.staterepo.git import tree as trees

        repo = pygit2.Repository(str(self.path))
        tree = trees.write(repo, repo[self.tip].peel(pygit2.Tree), changed)
        who = pygit2.Signature("A person", "person@example.org", 1_770_000_000, 0)
        return str(repo.create_commit("refs/heads/main", who, who, text, tree, [self.tip]))


@pytest.fixture
def state(laid_down: Path, tmp_path: Path) -> StateRepo:
    """Return a fresh bare state repo."""
    folder = tmp_path / "state.git"
    shutil.copytree(laid_down, folder)
    return StateRepo(folder)


@pytest.fixture
def request_json(demandops: Run, state: StateRepo) -> Callable[..., Ran]:
    """Return a function that sends goals through ``demandops request --output json``."""

    def send(*goals: object, more: tuple[str, ...] = ()) -> Ran:
        text = yaml.safe_dump_all(goals, sort_keys=False, allow_unicode=True)
        return demandops(
            "request", "-", "--state-repo", state.path, "--output", "json", *more, stdin=text
        )

    return send
