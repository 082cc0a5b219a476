"""`demandops upgrade` to another controller, and to a newer program that renders other files.

The newer program is a copy of this one with a higher render version and another time-out in
HelmReleases.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import StateRepoError
from demandops.repo import upgrade
from demandops.repo.git import remote_repository

from tests.integration.conftest import On
from tests.kit.cli import PROGRAM, Dialogue, Ran, Run, process
from tests.kit.goals import perception
from tests.kit.repo import GitRepo, hook
from tests.kit.rig import book, running

ROOT = Path(__file__).parents[2]
PARTS = ("generator", "ros_bridge", "templates", "appdefs", "state-repo-skeleton")
ROOT_FILE = "demandops.yaml"
URL = "https://git.example/fleet/state-repo.git"
OLDER = (
    "demandops.yaml: renderVersion: is 3, but this generator renders version 4; stop older "
    "generators, then run `demandops upgrade` to render everything again"
)
NEWER = (
    "demandops.yaml: renderVersion: is 4, but this generator renders version 3; update the "
    "generator"
)


@pytest.fixture(scope="session")
def newer_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a program with render version 4 and another time-out."""
    folder = tmp_path_factory.mktemp("newer")
    for part in PARTS:
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    for path, old, new in (
        ("generator/demandops/base/settings.py", "RENDER_VERSION = 3\n", "RENDER_VERSION = 4\n"),
        ("templates/flux/release.yaml.j2", "timeout: 5m", "timeout: 6m"),
    ):
        text = (folder / path).read_text()
        assert text.count(old) == 1
        (folder / path).write_text(text.replace(old, new))
    return folder


@pytest.fixture
def newer(newer_program: Path, state: GitRepo) -> Run:
    """Return a function that runs a command of the newer program on the state repo."""
    roots = os.pathsep.join(str(newer_program / part) for part in ("generator", "ros_bridge"))

    def call(*args: str, stdin: str = "") -> Ran:
        command = (*PROGRAM, *args, "--state-repo", state.path)
        environment = os.environ | {"PYTHONPATH": roots}
        return process(*command, input=stdin, cwd=newer_program, env=environment)

    return call


def verified(on: On) -> list[str]:
    rows = on.json("verify")
    assert all(row["holds"] for row in rows)
    return [row["skipped"] for row in rows]


# ---- the other controller ----


def test_on_a_terminal_it_asks_whether_the_clusters_are_ready(state: GitRepo) -> None:
    before = state.tip
    with Dialogue("upgrade", "--gitops", "argocd", "--state-repo", state.path) as asked:
        asked.read_until("[y/N]:")
        assert "before and after: docs/argocd.md" in asked.text
        assert state.tip == before
        asked.type("y\n")
        assert asked.end() == 0
    assert state.tip != before


def test_a_url_is_pushed_to_and_tried_again_when_somebody_was_first(
    on: On, demandops: Run, state: GitRepo, monkeypatch: pytest.MonkeyPatch
) -> None:
    on.book(perception())
    push, others = remote_repository.RemoteRepository.publish, []

    def after_somebody_else(self: Any, expected: Any, commit: Any) -> bool:
        if not others:
            others.append(state.commit({"README.md": "Ours.\n"}))
        return push(self, expected, commit)

    monkeypatch.setattr(remote_repository.RemoteRepository, "publish", after_somebody_else)
    url = f"file://{state.path}"
    ran = demandops("upgrade", "--state-repo", url, "--gitops", "argocd", "--output", "json")
    assert ran.json()["commit"] == state.tip
    assert state.files()["README.md"] == "Ours.\n"
    summaries = [text.split("\n")[0] for text in state.commits()]
    assert summaries[:2] == ["Render everything again, for Argo CD", "By hand"]
    assert verified(on) == [None]


def test_a_hook_of_the_state_repo_decides(on: On, state: GitRepo) -> None:
    hook(state, "pre-receive", "[ -e open ] || { echo closed today >&2; exit 1; }")
    assert "closed today" in on.refused("upgrade", "--gitops", "argocd")
    (state.path / "open").touch()
    assert on.json("upgrade", "--gitops", "argocd")["commit"] == state.tip


def test_a_state_repo_that_never_stands_still_is_told(
    on: On, state: GitRepo, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(upgrade, "_PAUSE_S", 0)
    monkeypatch.setattr(upgrade.CommitBatch, "publish", lambda self: False)
    told = on.refused("upgrade", "--gitops", "argocd")
    assert "during each of 10 attempts to render it; stop its generators and try again" in told


# ---- a newer program ----


def test_a_newer_program_serves_only_after_an_upgrade_and_the_older_only_before(
    on: On, state: GitRepo, newer: Run
) -> None:
    on.book(perception())
    before, goal = state.tip, yaml.safe_dump(perception(id="second"))
    for dry in ([], ["--dry-run"]):
        assert newer("request", "-", *dry, stdin=goal) == (1, "", f"error: {OLDER}\n")
    assert newer("bookkeeping").code == 0
    assert [row["skipped"] for row in newer("verify", "--output", "json").json()] == [
        "rendered by version 3, but this program renders version 4"
    ]
    assert state.tip == before

    old = state.files()
    ran = newer("upgrade")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.endswith(f"render version 3 → 4\nin commit {state.tip}\n")
    new = state.files()
    changed = {path for path in new if new[path] != old.get(path)}
    assert {path.rsplit("/", 1)[-1][:3] for path in changed} == {"dem", "od-", "of-"}
    assert new[ROOT_FILE] == old[ROOT_FILE].replace("renderVersion: 3", "renderVersion: 4")
    assert "From-Render-Version: 3\nGitops: flux\nRender-Version: 4\n" in state.commits()[0]
    assert all(row["holds"] for row in newer("verify", "--output", "json").json())
    assert "nothing to do" in newer("upgrade").out

    assert on.refused("request", "-", stdin=goal) == f"error: {NEWER}\n"
    assert "update the generator" in on.refused("upgrade")
    assert newer("request", "-", stdin=goal).code == 0
    assert newer("verify", "--output", "json").json()[0]["skipped"] is None


def test_a_running_generator_goes_on_for_the_other_controller_and_stops_for_a_newer_program(
    on: On, state: GitRepo, data_home: Path, newer: Run
) -> None:
    with running(state.path) as generator:
        assert on("upgrade", "--gitops", "argocd").code == 0
        after = len(state.commits())
        (receipt,) = book(generator, perception())
        assert (receipt.commit, len(state.commits())) == (state.tip, after + 1)
        kinds = [yaml.safe_load(t.split("---")[0])["kind"] for t in state.manifests().values()]
        assert "Application" in kinds and "HelmRelease" not in kinds
        assert newer("upgrade").code == 0
        tip = state.tip
        with pytest.raises(StateRepoError) as told:
            book(generator, perception(id="second"))
        assert (str(told.value), state.tip) == (NEWER, tip)


def test_an_upgrade_that_is_reverted_gives_the_repo_back_to_the_older_program(
    on: On, state: GitRepo, newer: Run
) -> None:
    on.book(perception())
    old = state.files()
    assert newer("upgrade").code == 0
    new = state.files()
    state.commit({path: old.get(path) for path in {*old, *new} if old.get(path) != new.get(path)})
    goal = yaml.safe_dump(perception(id="second"))
    assert newer("request", "-", stdin=goal).err == f"error: {OLDER}\n"
    on.book(perception(id="second"))
    assert verified(on) == [None]
