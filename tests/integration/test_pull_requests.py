"""`demandops check` on pull requests: branches of a state repo in which a demand is booked.

More is in ``stories/check.yaml``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.cli.authoring.check import LONGEST, MARK, report
from demandops.cli.main import run
from demandops.repo.merge_check import merge_check as checking
from demandops.repo.merge_check.merge_check import CheckResult
from demandops.repo.merge_check.rendered_charts import RenderedCharts

from tests.kit.cli import Run
from tests.kit.goals import EXPERIMENT
from tests.kit.repo import git

GOLDEN = Path(__file__).with_name("pull-request.md")
EDGE = "clusters/c-its/perception/edge"
DETECTION = f"{EDGE}/od-edge-station00.yaml"
CLIENT = "clusters/c-its/perception/vehicle00/mqtt-vehicle00-edge-source-d3ca91c2df6c.yaml"
LOST = "is generated, so a manual edit is lost; revert it"
Found = Callable[..., dict[str, Any]]

NEWER_PERCEPTION = [
    (f"robotkube-{name}\n    tag: 2025-04", f"robotkube-{name}\n    tag: 2025-09")
    for name in ("object-detection", "object-fusion", "k8s-configmap-watcher")
]
"""Edits of `registry/images.yaml` that give all services newer images."""


@pytest.fixture(scope="session")
def bare_template(bare_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bare state repo in which vehicle00's demand is booked."""
    folder = Path(shutil.copytree(bare_template, tmp_path_factory.mktemp("booked") / "state.git"))
    book(folder, 1)
    return folder


def book(bare: Path, step: int) -> None:
    assert run(["request", str(EXPERIMENT[step - 1]), "--state-repo", str(bare)]) == 0


@pytest.fixture
def branch(bare: Path, tmp_path: Path) -> Path:
    """A clone of the state repo, with a new branch `edit` checked out."""
    folder = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", "--no-local", str(bare), str(folder))
    git(folder, "checkout", "--quiet", "-b", "edit")
    return folder


@pytest.fixture
def check(branch: Path, demandops: Run) -> Run:
    return lambda *args: demandops("check", branch, *args)


@pytest.fixture
def found(check: Run) -> Found:
    return lambda *args: json.loads(check("--output", "json", *args).out)


def commit(folder: Path, text: str = "An edit") -> None:
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "-m", text)


def edit(file: Path, *replaced: tuple[str, str]) -> None:
    text = file.read_text()
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    file.write_text(text)


def newer_images(branch: Path) -> None:
    edit(branch / "registry" / "images.yaml", *NEWER_PERCEPTION)


def claim(folder: Path, needle: str = "\napplication:\n") -> Path:
    files = sorted((folder / "ledger").rglob("*.yaml"))
    (found,) = [path for path in files if needle in path.read_text()]
    return found


def delete_a_claim(branch: Path) -> None:
    claim(branch, "connection:\n  id: vehicle00/edge").unlink()


def with_requesters(branch: Path, names: list[str]) -> None:
    file = claim(branch)
    file.write_text(json.dumps(yaml.safe_load(file.read_text()) | {"requesters": names}))


# # ---- manual edits ----

EDITS = yaml.safe_load(Path(__file__).with_name("edits.yaml").read_text())


def test_an_edit_becomes_an_override_to_paste(branch: Path, check: Run, found: Found) -> None:
    for case in EDITS:
        path = case["path"]
        before = (branch / path).read_text()
        edit(branch / path, *case["edit"].items())
        commit(branch)
        (suggested,) = found()["suggestions"]
        ran, name = check(), f"overrides/{Path(path).name}"
        (branch / path).write_text(before)
        assert ran.code == 1
        assert ran.err.startswith(f"error: {path}: {LOST}, and merge {name} as shown")
        assert ran.out.startswith(f"\ninstead of editing {path}, write {name}:\n\n")
        assert suggested["text"] in ran.out
        made = yaml.safe_load(suggested["text"])
        effects = {key: made[key] for key in ("values", "images", "replicas") if key in made}
        assert effects == case["effects"]
        assert (made["kind"], made["owner"]) == ("Override", "Petra Platform")
        assert made["select"] == case.get("select", made["select"])
        for key in ("not_covered", "other_releases"):
            assert suggested[key] == case.get(key, [])
        assert suggested["instead_of"] == path


def test_edits_of_generated_files_are_refused_with_the_remedy(branch: Path, check: Run) -> None:
    version = ("object-detection-0.1.0", "object-detection-0.2.0")
    edit(branch / DETECTION, version, ("interval: 10m", "interval: 10m\n  suspend: true"))
    ran = check()
    assert (ran.out, ran.err.startswith(f"error: {DETECTION}: {LOST}, and change ")) == ("", True)
    (branch / DETECTION).write_text("kind: [\n")
    assert check().code == 1
    for path in (DETECTION, CLIENT):
        (branch / path).unlink()
    edit(branch / "bootstrap" / "c-its.yaml", ("prune: true", "prune: false"))
    for path in (f"{EDGE}/extra.yaml", f"{EDGE}/README.md", "ledger/notes.yaml",
                 "bootstrap/extra.yaml"):  # fmt: skip
        (branch / path).parent.mkdir(exist_ok=True)
        (branch / path).write_text("kind: Secret\n")
    ran = check()
    assert (ran.code, ran.out) == (1, "")
    told = dict(line.removeprefix("error: ").split(": ", 1) for line in ran.err.splitlines())
    assert {path: text.partition(";")[0].partition(",")[0] for path, text in told.items()} == {
        "bootstrap/c-its.yaml": "is generated",
        "bootstrap/extra.yaml": "is in a generated folder",
        f"{EDGE}/extra.yaml": "is in a generated folder",
        DETECTION: "is generated",
        CLIENT: "is generated",
        "ledger/notes.yaml": "is not the path of a claim",
    }
    assert "delete its claims in ledger/, or deny it by an override" in told[DETECTION]
    assert "change demandops.yaml, inventory/ or policy/ instead" in told["bootstrap/c-its.yaml"]


# ---- claims and configuration, and what follows ----


def test_a_symbolic_link_is_not_followed(branch: Path, tmp_path: Path, found: Found) -> None:
    secret = tmp_path / "secret"
    secret.write_text("password: hunter2\n")
    brokers = branch / "inventory" / "brokers.yaml"
    brokers.unlink()
    brokers.symlink_to(secret)
    data = found()
    links = {one["file"] for one in data["faults"] if "is a symbolic link" in one["message"]}
    assert links == {"inventory/brokers.yaml"}
    assert "hunter2" not in json.dumps(data)


def test_the_check_of_another_render_version_says_so(
    check: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checking, "RENDER_VERSION", 4)
    told = check().err
    assert told.startswith("error: demandops.yaml:15: renderVersion: is 3, but this program ")


# ---- branches ----


@pytest.mark.parametrize("base", [[], ["--base", "origin/main"]], ids=["default", "named"])
def test_a_shallow_clone_is_told_how_to_become_whole(
    bare: Path, branch: Path, tmp_path: Path, demandops: Run, base: list[str]
) -> None:
    delete_a_claim(branch)
    commit(branch)
    git(branch, "push", "--quiet", "origin", "edit")
    folder = tmp_path / "shallow"
    git(tmp_path, "clone", "-q", "--depth", "1", "--branch", "edit", bare.as_uri(), str(folder))
    main = "+refs/heads/main:refs/remotes/origin/main"
    for fetched in ([], [main], ["--unshallow"]):
        if fetched:
            git(folder, "fetch", "--quiet", "origin", *fetched)
        ran = demandops("check", folder, *base)
        shallow = fetched != ["--unshallow"]
        assert ran.code == shallow
        assert ("fetch all commits: git fetch --unshallow origin " in ran.err) == shallow


def test_a_folder_that_is_no_git_checkout_is_checked_all_the_same(branch: Path, check: Run) -> None:
    shutil.rmtree(branch / ".git")
    assert check().code == 0
    edit(branch / "inventory" / "nodes.yaml", ("cluster: c-its", "cluster: c-itz"))
    assert check().code == 1
    ran = check("--base", "HEAD")
    assert (ran.code, ran.out) == (1, "")
    assert "is not a Git checkout; leave out --base" in ran.err


def test_a_checkout_that_git_cannot_open_is_not_taken_for_files_without_git(
    branch: Path, demandops: Run
) -> None:
    """Git cannot open a checkout of another user, nor a work tree whose repository is missing."""
    shutil.rmtree(branch / ".git")
    (branch / ".git").write_text("gitdir: /nowhere\n")
    for command in (["check"], ["get", "nodes", "--state-repo"]):
        ran = demandops(*command, branch)
        assert (ran.code, ran.out) == (1, "")
        assert ran.err.startswith(f"error: {branch} is a Git repository that cannot be opened: ")
        remedy = f"run `git config --global --add safe.directory {branch}`"
        assert ran.err.rstrip().endswith(remedy)


# ---- Markdown ----


def test_the_report_is_ready_to_be_posted(branch: Path, check: Run) -> None:
    base = git(branch, "rev-parse", "origin/main")[:10]
    ran = check("--output", "markdown")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith(f"{MARK}\n## DemandOps: valid, and every release renders\n")
    assert ran.out.endswith(f"`{base}`.\n\nMerging changes no release and no demand.\n")
    newer_images(branch)
    delete_a_claim(branch)
    edit(branch / DETECTION, ("tolerations: []", "tolerations: [{key: gpu}]"))
    commit(branch)
    ran = check("--output", "markdown")
    assert (ran.code, ran.err) == (1, "")
    assert ran.out.replace(base, "0123456789") == GOLDEN.read_text()


def test_what_people_wrote_cannot_act_in_a_comment(branch: Path, check: Run) -> None:
    evil = "`@everyone` </details> [x](javascript:0) ```` ![i](http://x) <b>|"
    with_requesters(branch, [evil])
    (branch / EDGE / "a&<b>`.yaml").write_text("x")
    ran = check("--output", "markdown")
    assert ran.code == 1
    assert f"`````requester {evil}`````" in ran.out
    outside = without_code(ran.out)
    for mark in ("@", "javascript", "http:", "<b>", "]("):
        assert mark not in outside
    charts = RenderedCharts(not_rendered={"cam": "its dependency @everyone is not in charts/"})
    comment = report(CheckResult((), charts=charts))
    assert "\nchart cam not rendered: `its dependency @everyone is not in charts/`\n" in comment


def without_code(text: str) -> str:
    """Return a Markdown text without its code spans and fences, by CommonMark's rules."""
    kept, rest = "", text
    while "`" in rest:
        before, _, rest = rest.partition("`")
        marks = 1 + len(rest) - len(rest.lstrip("`"))
        rest = rest.lstrip("`")
        kept += before
        end = next(
            i
            for i in range(len(rest))
            if rest.startswith("`" * marks, i)
            and not rest.startswith("`", i + marks)
            and (i == 0 or rest[i - 1] != "`")
        )
        rest = rest[end + marks :]
    return kept + rest


def test_a_report_is_never_longer_than_a_comment_may_be(branch: Path, check: Run) -> None:
    with_requesters(branch, [f"vehicle-{number:05}" for number in range(4_000)])
    newer_images(branch)
    ran = check("--output", "markdown")
    assert ran.code == 0
    assert len(ran.out) <= LONGEST == 60_000
    assert ran.out.startswith(f"{MARK}\n## DemandOps: valid")
    assert "Releases: 3 to change." in ran.out
    assert "\n3 parts of this report are left out because " in ran.out[-200:]
