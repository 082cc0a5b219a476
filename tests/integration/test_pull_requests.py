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
from tests.kit.repo import GitRepo, git

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


# ---- what Git would commit ----

NODES = "inventory/nodes.yaml"
BROKEN = "kind: ["


def ignore(branch: Path) -> None:
    (branch / ".gitignore").write_text("overrides/mine.yaml\n.venv\n")
    (branch / ".venv").mkdir()
    (branch / "overrides" / "mine.yaml").write_text(BROKEN)


def ignore_a_tracked_file(branch: Path) -> None:
    (branch / ".gitignore").write_text("inventory/\n")
    (branch / NODES).write_text(BROKEN)


def convert_line_ends(branch: Path) -> None:
    git(branch, "config", "core.autocrlf", "true")
    for file in branch.glob("[!.]*/**/*.yaml"):
        file.write_bytes(file.read_bytes().replace(b"\n", b"\r\n"))


def encrypt(branch: Path) -> None:
    git(branch, "config", "filter.box.clean", "tr a-z b-za")
    (branch / ".gitattributes").write_text("inventory/nodes.yaml filter=box\n")
    git(branch, "add", "--renormalize", NODES)


def miss_a_filter(branch: Path) -> None:
    git(branch, "config", "filter.box.clean", "no-such-program")
    git(branch, "config", "filter.box.required", "true")
    (branch / ".gitattributes").write_text("inventory/nodes.yaml filter=box\n")
    (branch / NODES).touch()


def hide(branch: Path, mark: str) -> None:
    git(branch, "update-index", mark, NODES)
    (branch / NODES).write_text(BROKEN)


def intend_to_add(branch: Path) -> None:
    (branch / "overrides" / "new.yaml").write_text(BROKEN)
    git(branch, "add", "--intent-to-add", "overrides/new.yaml")


def edit_a_part(branch: Path) -> None:
    git(branch, "sparse-checkout", "set", "--sparse-index", "registry")
    (branch / "registry" / "images.yaml").write_text(BROKEN)


def conflict(branch: Path) -> None:
    for name, tag in (("edit", "2025-09"), ("other", "2025-10")):
        git(branch, "checkout", "-q", "-B", name, "main")
        edit(branch / "registry" / "images.yaml", ("tag: 2025-04", f"tag: {tag}"))
        commit(branch)
    git(branch, "merge", "-q", "edit", check=False)


def link_a_folder(branch: Path) -> None:
    shutil.rmtree(branch / "overrides")
    (branch / "overrides").symlink_to("inventory")


def encode(branch: Path) -> None:
    (branch / ".gitattributes").write_text("*/nodes.yaml text working-tree-encoding=UTF-16\n")
    (branch / NODES).write_bytes((branch / NODES).read_text().encode("utf-16"))


@pytest.mark.parametrize(
    ("lay", "told"),
    [
        (ignore, ""),
        (ignore_a_tracked_file, f"error: {NODES}: line 2, column 1: not valid YAML"),
        (convert_line_ends, ""),
        (encrypt, f"error: {NODES}: apiVersion: is missing"),
        (miss_a_filter, f"{NODES}: clean filter 'box' failed; mend it until `git add --all` "),
        (lambda branch: hide(branch, "--assume-unchanged"), ""),
        (lambda branch: hide(branch, "--skip-worktree"), ""),
        (intend_to_add, "error: overrides/new.yaml: line 2, column 1: not valid YAML"),
        (edit_a_part, "error: registry/images.yaml: line 2, column 1: not valid YAML"),
        (conflict, "error: registry/images.yaml: is not merged yet; edit it"),
        (link_a_folder, "error: overrides: is a symbolic link"),
        (encode, ""),
    ],
)  # fmt: skip
def test_what_git_would_commit_counts(
    branch: Path, check: Run, lay: Callable[[Path], None], told: str
) -> None:
    lay(branch)
    ran = check()
    assert ran.code == bool(told)
    assert told in ran.err


def test_git_runs_no_program_of_the_checkout_and_writes_nothing_into_it(
    branch: Path, check: Run
) -> None:
    (branch / "touch.sh").write_text("#!/bin/sh\ntouch ran\n")
    (branch / "touch.sh").chmod(0o755)
    git(branch, "update-index", "--split-index")
    git(branch, "config", "core.splitIndex", "true")
    git(branch, "config", "core.fsmonitor", str(branch / "touch.sh"))
    git(branch, "config", "core.hooksPath", "hooks")
    (branch / "hooks").mkdir()
    (branch / "touch.sh").rename(branch / "hooks" / "post-index-change")
    newer_images(branch)
    before = {path: path.read_bytes() for path in branch.rglob("*") if path.is_file()}
    assert check().code == 0
    assert {path: path.read_bytes() for path in branch.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("kind", ["tree:0", "blob:none"])
def test_a_partial_clone_is_told_how_to_become_whole(
    bare: Path, tmp_path: Path, demandops: Run, kind: str
) -> None:
    git(bare, "config", "uploadpack.allowFilter", "true")
    folder, edited = tmp_path / "partial", "registry/images.yaml"
    book(bare, 2)
    git(tmp_path, "clone", "-q", f"--filter={kind}", bare.as_uri(), str(folder))
    (folder / edited).write_text(BROKEN)
    for command in (["check", folder, "--base", "main~1"], ["diff", "main~1", "main"]):
        ran = demandops(*command, *([] if "check" in command else ["--state-repo", folder]))
        assert (ran.code, ran.out) == (1, "")
        _, _, remedy = ran.err.rstrip().partition("lacks objects; fetch them: git -C ")
        assert remedy == f"{folder} fetch --refetch --no-filter origin"
    git(folder, "fetch", "-q", "--refetch", "--no-filter", "origin")
    ran = demandops("check", folder, "--base", "main~1")
    assert ran.err.splitlines()[-1].startswith(f"error: {edited}: line 2, column 1: not valid YAML")


def test_a_linked_work_tree_is_a_checkout(branch: Path, tmp_path: Path, demandops: Run) -> None:
    git(branch, "worktree", "add", "-q", str(tmp_path / "linked"), "-b", "more")
    newer_images(tmp_path / "linked")
    assert "what merging would do" in demandops("check", tmp_path / "linked").out


def test_a_fleet_in_a_folder_of_another_repository_is_refused(
    branch: Path, tmp_path: Path, demandops: Run
) -> None:
    whole = tmp_path / "whole"
    git(tmp_path, "init", "-q", str(whole))
    shutil.copytree(branch, whole / "fleet", ignore=shutil.ignore_patterns(".git"))
    for command in (["check"], ["get", "nodes", "--state-repo"], ["log", "--state-repo"]):
        ran = demandops(*command, whole / "fleet")
        assert (ran.code, ran.out) == (1, "")
        told = f"error: {whole}/fleet is a folder of the Git repository {whole}, but a state repo "
        assert ran.err.startswith(told)
    assert f"name {branch}\n" in demandops("check", branch / "inventory").err


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
    assert f"    + requester {evil}\n`````" in ran.out
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
    assert "~ od-edge-station00" in ran.out and "\n…\n" in ran.out
    assert "\nParts cut or left out, because a comment has a limited length: " in ran.out[-200:]


# ---- what main has become meanwhile ----

NODE = "apiVersion: demandops/v1\nkind: Nodes\nnodes: [{id: late, type: vehicle, cluster: c-its}]\n"


@pytest.mark.parametrize(
    ("on_main", "told"),
    [
        # a fault of somebody else, with which nothing of a merge would be in effect
        ({"overrides/odd.yaml": "kind: Nothing\n"}, "overrides/odd.yaml: apiVersion: is missing"),
        # and one that neither side has alone
        ({"inventory/nodes/other.yaml": NODE}, "'late' is in inventory/nodes/other.yaml too"),
    ],
)
def test_the_merged_result_is_judged(
    branch: Path, check: Run, state: GitRepo, on_main: dict[str, str], told: str
) -> None:
    file = branch / "inventory" / "nodes" / "mine.yaml"
    file.parent.mkdir(exist_ok=True)
    file.write_text(NODE)
    commit(branch)
    assert check().code == 0
    state.commit(on_main)
    git(branch, "fetch", "--quiet", "origin")
    ran = check()
    assert ran.code == 1
    assert told in ran.err and "(once merged into origin/main, which has newer commits)" in ran.err
