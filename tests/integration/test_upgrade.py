"""`demandops upgrade` to another controller, and to a newer program that renders other files.

The newer program is a copy of this one with a higher render version and another time-out in
HelmReleases. It runs in a process of its own.
"""

from __future__ import annotations

import json
import os
import pty
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pygit2
import pytest
import yaml
from demandops.base.errors import StateRepoError
from demandops.repo import upgrade
from demandops.repo.git import remote_repository
from demandops.serve.generator import Generator

from tests.kit.cli import Ran, Run
from tests.kit.goals import perception
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import GitRepo

ROOT = Path(__file__).parents[2]
PARTS = ("generator", "ros_bridge", "templates", "appdefs", "state-repo-skeleton")
ROOT_FILE = "demandops.yaml"
URL = "https://git.example/fleet/state-repo.git"
OLDER = (
    "demandops.yaml: renderVersion: is 2, but this generator renders version 3; stop older "
    "generators, then run `demandops upgrade` to render everything again"
)
NEWER = (
    "demandops.yaml: renderVersion: is 3, but this generator renders version 2; update the "
    "generator"
)


# This program runs a command for each line of its input, all in one process. A line has the
# arguments and the standard input of the command.
SERVE = """
import io, json, os, sys
from contextlib import redirect_stderr, redirect_stdout
from demandops.cli.main import run
commands, answers = sys.stdin, sys.stdout
for line in commands:
    args, text, os.environ["DEMANDOPS_DATA_HOME"] = json.loads(line)
    sys.stdin = io.TextIOWrapper(io.BytesIO(text.encode()), "utf-8")
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = run(args)
    print(json.dumps([code, out.getvalue(), err.getvalue()]), file=answers, flush=True)
"""


@pytest.fixture(scope="session")
def newer_program(tmp_path_factory: pytest.TempPathFactory) -> Iterator[subprocess.Popen[str]]:
    """A process that runs commands of a program with render version 3 and another time-out."""
    folder = tmp_path_factory.mktemp("newer")
    for part in PARTS:
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    for path, old, new in (
        ("generator/demandops/base/settings.py", "RENDER_VERSION = 2\n", "RENDER_VERSION = 3\n"),
        ("templates/flux/release.yaml.j2", "timeout: 5m", "timeout: 6m"),
    ):
        text = (folder / path).read_text()
        assert text.count(old) == 1
        (folder / path).write_text(text.replace(old, new))
    roots = (folder / "generator", folder / "ros_bridge")
    with subprocess.Popen(
        [sys.executable, "-c", SERVE],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, roots))},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        yield process


@pytest.fixture
def newer(newer_program: subprocess.Popen[str], state: GitRepo, data_home: Path) -> Run:
    """Return a function that runs a command of the newer program on the state repo."""

    def call(*args: str, stdin: str = "") -> Ran:
        options = ["--state-repo", str(state.path)] if args[0] != "init" else []
        assert newer_program.stdin and newer_program.stdout
        print(
            json.dumps([[*args, *options], stdin, str(data_home)]),
            file=newer_program.stdin,
            flush=True,
        )
        return Ran(*json.loads(newer_program.stdout.readline()))

    return call


@pytest.fixture
def upgraded(demandops: Run, state: GitRepo) -> Callable[..., Ran]:
    def call(*args: str) -> Ran:
        return demandops("upgrade", "--state-repo", state.path, *args)

    return call


@pytest.fixture
def book(demandops: Run, state: GitRepo) -> Callable[..., Ran]:
    def call(**options: Any) -> Ran:
        goal = yaml.safe_dump(perception(**options))
        return demandops("request", "-", "--state-repo", state.path, stdin=goal)

    return call


def verified(demandops: Run, state: GitRepo) -> list[str]:
    rows = demandops("verify", "--state-repo", state.path, "--output", "json").json()
    assert all(row["holds"] for row in rows)
    return [row["skipped"] for row in rows]


# ---- the other controller ----


def test_all_goes_over_in_one_commit_and_back_and_verifies(
    demandops: Run, state: GitRepo, upgraded: Callable[..., Ran], book: Callable[..., Ran]
) -> None:
    assert book().code == 0
    flux, tip = state.files(), state.tip
    said = upgraded("--gitops", "argocd", "--output", "json").json()
    assert (said["outcome"], said["commit"]) == ("upgraded", state.tip)
    assert said["gitops"] == {"from": "flux", "to": "argocd"}
    assert pygit2.Repository(str(state.path))[state.tip].parents[0].id == pygit2.Oid(hex=tip)  # type: ignore[attr-defined]
    argocd = state.files()
    assert said["written"] == sorted(p for p in argocd if argocd[p] != flux.get(p))
    assert said["removed"] == sorted(flux.keys() - argocd.keys())
    kinds = {yaml.safe_load(text.split("---")[0])["kind"] for text in state.manifests().values()}
    assert "Application" in kinds and "HelmRelease" not in kinds
    assert verified(demandops, state) == [None]

    assert upgraded("--gitops", "flux").code == 0
    back = state.files()
    assert back[ROOT_FILE] == f"{flux[ROOT_FILE]}\nargocd:\n  url: {URL}\n"
    assert {p: t for p, t in back.items() if p != ROOT_FILE} == {
        p: t for p, t in flux.items() if p != ROOT_FILE
    }
    assert verified(demandops, state) == [None]


def test_the_commit_says_what_it_did(state: GitRepo, upgraded: Callable[..., Ran]) -> None:
    assert upgraded("--gitops", "argocd").code == 0
    assert state.commits()[0] == (
        "Render everything again, for Argo CD\n"
        "\n"
        "Why: `demandops upgrade` renders everything with render version 2, for Argo CD "
        "instead of Flux.\n"
        "\n"
        "Files written or removed:\n"
        "  1 in bootstrap/c-its.yaml\n"
        "  3 in clusters/c-its/perception\n"
        "  1 in demandops.yaml\n"
        "\n"
        "Operation: upgrade\n"
        "From-Render-Version: 2\n"
        "From-Gitops: flux\n"
        "Gitops: argocd\n"
        "Render-Version: 2\n"
    )


def test_what_a_person_wrote_in_the_file_stays(
    state: GitRepo, upgraded: Callable[..., Ran]
) -> None:
    text = (
        "# Ours.\napiVersion: demandops/v1\nkind: StateRepository\n"
        "gitops: 'flux'   # until spring\nsource: fleet # as in the wiki\n"
        f"renderVersion: 2\nflux: {{url: '{URL}', interval: 30s}} # asked for by Petra"
    )
    state.commit({ROOT_FILE: text})
    assert upgraded("--gitops", "argocd", "--url", "ssh://git@git.example/fleet.git").code == 0
    assert state.files()[ROOT_FILE] == (
        text.replace("'flux'", "argocd") + "\n\nargocd:\n  url: ssh://git@git.example/fleet.git\n"
    )


def test_a_dry_run_tells_all_and_writes_nothing(
    state: GitRepo, upgraded: Callable[..., Ran], book: Callable[..., Ran]
) -> None:
    assert book().code == 0
    before = state.tip
    ran = upgraded("--gitops", "argocd", "--dry-run")
    assert (ran.code, ran.err, state.tip) == (0, "", before)
    assert ran.out == (
        "would write 5 and remove 2 files\n"
        "gitops flux → argocd\n"
        f"argocd.url {URL}\n"
        "  write  bootstrap/c-its.yaml\n"
        "  remove clusters/c-its/perception/_charts/object-detection-0.1.0.yaml\n"
        "  remove clusters/c-its/perception/_charts/object-fusion-0.1.0.yaml\n"
        "  write  clusters/c-its/perception/_domain.yaml\n"
        "  write  clusters/c-its/perception/edge/od-edge-vehicle00.yaml\n"
        "  write  clusters/c-its/perception/edge/of-edge-object-detection-fusion-cf7e0180a8bb.yaml"
        "\n  write  demandops.yaml\n"
        "\n"
        "a change of controller needs steps on the clusters, before and after: docs/argocd.md, "
        "'From Flux to Argo CD, and back'\n"
        "\n"
        "after the upgrade, on the clusters:\n"
        "- c-its: apply the cluster's bootstrap file again, because the file changed\n"
        "      git show main:bootstrap/c-its.yaml | kubectl apply -f -\n"
    )
    data = upgraded("--gitops", "argocd", "--dry-run", "--output", "json").json()
    assert (data["outcome"], data["commit"], state.tip) == ("would-change", before, before)


@pytest.mark.parametrize(
    ("answer", "code"), [pytest.param("n", 1, marks=pytest.mark.nightly), ("y", 0)]
)
def test_on_a_terminal_it_asks_whether_the_clusters_are_ready(
    state: GitRepo, data_home: Path, answer: str, code: int
) -> None:
    before = state.tip
    command = [sys.executable, "-m", "demandops.cli.main", "upgrade", "--gitops", "argocd"]
    ours, theirs = pty.openpty()
    os.write(ours, f"{answer}\n".encode())
    done = subprocess.run(
        [*command, "--state-repo", str(state.path)],
        stdin=theirs,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    os.close(ours)
    os.close(theirs)
    assert done.returncode == code
    assert "before and after: docs/argocd.md" in done.stdout.splitlines()[0]
    assert (state.tip == before) is (code == 1)
    if code:
        assert done.stderr == "error: nothing was changed; do these steps first, or give --yes\n"


@pytest.mark.parametrize("more", [[], ["--gitops", "flux"], ["--url", URL]], ids=" ".join)
def test_where_nothing_would_change_nothing_is_committed(
    state: GitRepo, upgraded: Callable[..., Ran], more: list[str]
) -> None:
    before = state.tip
    ran = upgraded(*more)
    assert (ran.code, ran.err, state.tip) == (0, "", before)
    assert ran.out == (
        f"nothing to do: at {before}, everything is rendered for flux with render version 2\n"
    )
    assert upgraded(*more, "--output", "json").json()["outcome"] == "unchanged"


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (
            ["--url", "https://git.example/else.git"],
            f"demandops.yaml: flux.url: is set to {URL} already; change it in this file, or "
            "leave out --url",
        ),
        (
            ["--gitops", "argocd", "--url", "git.example"],
            "demandops.yaml: argocd.url: 'git.example' is not a URL that clusters can fetch",
        ),
    ],
)
def test_a_url_that_cannot_be_taken_is_told(
    state: GitRepo, upgraded: Callable[..., Ran], args: list[str], said: str
) -> None:
    before = state.tip
    ran = upgraded(*args)
    assert (ran.code, ran.out, state.tip) == (1, "", before)
    assert ran.err.startswith(f"error: {said}")


def test_a_file_that_cannot_be_edited_by_the_program_is_told(
    state: GitRepo, upgraded: Callable[..., Ran]
) -> None:
    root = {
        "apiVersion": "demandops/v1",
        "kind": "StateRepository",
        "gitops": "flux",
        "renderVersion": 2,
        "flux": {"url": URL},
    }
    before = state.commit({ROOT_FILE: json.dumps(root)})
    ran = upgraded("--gitops", "argocd")
    assert (ran.code, ran.out, state.tip) == (1, "", before)
    assert ran.err == (
        "error: demandops.yaml: argocd: cannot be set automatically; set it to {'url': "
        f"'{URL}'}} by hand\n"
    )


def test_a_state_repo_that_is_not_valid_is_not_upgraded(
    state: GitRepo, upgraded: Callable[..., Ran]
) -> None:
    nodes = state.files()["inventory/nodes.yaml"]
    before = state.commit(
        {"inventory/nodes.yaml": nodes.replace("cluster: c-its", "cluster: c-itz", 1)}
    )
    ran = upgraded("--gitops", "argocd")
    assert (ran.code, ran.out, state.tip) == (1, "", before)
    assert "error: inventory/nodes.yaml: nodes[0].cluster: 'c-itz' is not in" in ran.err


def test_a_url_is_pushed_to_and_tried_again_when_somebody_was_first(
    demandops: Run, state: GitRepo, book: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert book().code == 0
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
    assert verified(demandops, state) == [None]


def test_a_state_repo_that_never_stands_still_is_told(
    state: GitRepo, monkeypatch: pytest.MonkeyPatch, upgraded: Callable[..., Ran]
) -> None:
    monkeypatch.setattr(upgrade, "_PAUSE_S", 0)
    monkeypatch.setattr(upgrade.CommitBatch, "publish", lambda self: False)
    before = state.tip
    ran = upgraded("--gitops", "argocd")
    assert (ran.code, state.tip) == (1, before)
    assert ran.err == (
        f"error: {state.path} got new commits, or another process locked it, during each of 10 "
        "attempts to render it; stop its generators and try again\n"
    )


def test_a_running_generator_goes_on_for_the_other_controller(
    state: GitRepo, data_home: Path, upgraded: Callable[..., Ran]
) -> None:
    generator = Generator(str(state.path))
    try:
        assert upgraded("--gitops", "argocd").code == 0
        after = len(state.commits())
        assert generator.submit(perception()).future.result(PATIENCE_S).commit == state.tip
    finally:
        generator.close()
    assert len(state.commits()) == after + 1
    kinds = {yaml.safe_load(text.split("---")[0])["kind"] for text in state.manifests().values()}
    assert "Application" in kinds and "HelmRelease" not in kinds


# ---- a newer program ----


def test_a_newer_program_serves_only_after_an_upgrade_and_the_older_only_before(
    demandops: Run, state: GitRepo, newer: Run, book: Callable[..., Ran]
) -> None:
    assert book().code == 0
    before, goal = state.tip, yaml.safe_dump(perception(id="second"))
    for args in (["request", "-"], ["request", "-", "--dry-run"]):
        ran = newer(*args, stdin=goal)
        assert (ran.code, ran.out, ran.err) == (1, "", f"error: {OLDER}\n")
    assert newer("bookkeeping").code == 0
    assert [row["skipped"] for row in json.loads(newer("verify", "--output", "json").out)] == [
        "rendered by version 2, but this program renders version 3"
    ]
    assert state.tip == before

    old = state.files()
    ran = newer("upgrade")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out == (
        f"wrote 3 and removed 0 files\nrender version 2 → 3\nin commit {state.tip}\n"
    )
    new = state.files()
    changed = {path for path in new if new[path] != old.get(path)}
    assert {path.rsplit("/", 1)[-1][:3] for path in changed} == {"dem", "od-", "of-"}
    assert new[ROOT_FILE] == old[ROOT_FILE].replace("renderVersion: 2", "renderVersion: 3")
    assert "From-Render-Version: 2\nGitops: flux\nRender-Version: 3\n" in state.commits()[0]
    assert all(row["holds"] for row in json.loads(newer("verify", "--output", "json").out))
    assert "nothing to do" in newer("upgrade").out

    ran = demandops("request", "-", "--state-repo", state.path, stdin=goal)
    assert (ran.code, ran.err) == (1, f"error: {NEWER}\n")
    ran = demandops("upgrade", "--state-repo", state.path)
    assert (ran.code, "update the generator" in ran.err) == (1, True)
    assert newer("request", "-", stdin=goal).code == 0
    assert json.loads(newer("verify", "--output", "json").out)[0]["skipped"] is None


def test_a_running_generator_stops_taking_demands_when_a_newer_one_takes_over(
    state: GitRepo, data_home: Path, newer: Run
) -> None:
    generator = Generator(str(state.path))
    try:
        generator.submit(perception()).future.result(PATIENCE_S)
        assert newer("upgrade").code == 0
        tip = state.tip
        with pytest.raises(StateRepoError) as told:
            generator.submit(perception(id="second")).future.result(PATIENCE_S)
        assert (str(told.value), state.tip) == (NEWER, tip)
    finally:
        generator.close()


def test_an_upgrade_that_is_reverted_gives_the_repo_back_to_the_older_program(
    demandops: Run, state: GitRepo, newer: Run, book: Callable[..., Ran]
) -> None:
    assert book().code == 0
    old = state.files()
    assert newer("upgrade").code == 0
    new = state.files()
    state.commit(
        {path: old.get(path) for path in old.keys() | new.keys() if old[path] != new[path]}
    )
    goal = yaml.safe_dump(perception(id="second"))
    assert newer("request", "-", stdin=goal).err == f"error: {OLDER}\n"
    assert book(id="second").code == 0
    assert verified(demandops, state) == [None]


def test_a_newer_program_lays_down_a_repo_of_its_own_version(newer: Run, tmp_path: Path) -> None:
    folder = tmp_path / "fleet"
    assert newer("init", str(folder)).code == 0
    assert "renderVersion: 3\n" in (folder / ROOT_FILE).read_text()
