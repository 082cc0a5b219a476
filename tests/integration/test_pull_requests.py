"""`demandops check` on pull requests: branches of a state repo in which a demand is booked."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.cli.main import run
from demandops.cli.repo.check import LONGEST, MARK, report
from demandops.repo.pull_request import merge_check as checking
from demandops.repo.pull_request.merge_check import CheckResult
from demandops.repo.pull_request.rendered_charts import RenderedCharts

from tests.kit.cli import Run
from tests.kit.goals import APP
from tests.kit.repo import git

EXAMPLES = Path(__file__).parents[2] / "examples" / "experiment"
GOLDEN = Path(__file__).with_name("pull-request.md")
EDGE = "clusters/c-its/perception/edge"
FUSION = f"{EDGE}/of-edge-object-detection-fusion-cf7e0180a8bb.yaml"
DETECTION = f"{EDGE}/od-edge-station00.yaml"
CLIENT = "clusters/c-its/perception/vehicle00/mqtt-vehicle00-edge-source-d3ca91c2df6c.yaml"
LOST = "is generated, so a manual edit is lost; revert it"
BY_HAND = "and change the configuration or write an override instead (docs/overrides.md)"

NEWER_PERCEPTION = [
    (f"robotkube-{name}\n    tag: 2025-04", f"robotkube-{name}\n    tag: 2025-09")
    for name in ("object-detection", "object-fusion", "k8s-configmap-watcher")
]
"""Edits of `registry/images.yaml` that give all services newer images."""


@pytest.fixture(scope="session")
def bare_template(bare_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bare state repo in which vehicle00's demand is booked."""
    folder = Path(shutil.copytree(bare_template, tmp_path_factory.mktemp("booked") / "state.git"))
    book(folder, "1-vehicle00-joins")
    return folder


def book(bare: Path, step: str) -> None:
    assert run(["request", str(EXAMPLES / f"{step}.yaml"), "--state-repo", str(bare)]) == 0


@pytest.fixture
def branch(bare: Path, tmp_path: Path) -> Path:
    """A clone of the state repo, with a new branch `edit` checked out."""
    folder = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", str(bare), str(folder))
    git(folder, "checkout", "--quiet", "-b", "edit")
    return folder


@pytest.fixture
def check(branch: Path, demandops: Run) -> Run:
    return lambda *args: demandops("check", branch, *args)


@pytest.fixture
def found(check: Run) -> Callable[..., dict[str, Any]]:
    return lambda *args: json.loads(check("--output", "json", *args)[1])


def commit(folder: Path, text: str = "An edit") -> None:
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "-m", text)


def edit(file: Path, *replaced: tuple[str, str]) -> None:
    text = file.read_text()
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    file.write_text(text)


def claims(folder: Path, needle: str = "") -> list[Path]:
    found = sorted((folder / "ledger").rglob("*.yaml"))
    return [path for path in found if needle in path.read_text()]


# # ---- manual edits ----


def test_edited_values_image_and_replicas_become_an_override_to_paste(
    branch: Path, check: Run
) -> None:
    edit(branch / FUSION, ("replicas: 1", "replicas: 3"), ("domainId: 0", "domainId: 7"))
    text = (branch / FUSION).read_text()
    (branch / FUSION).write_text(text.replace('tag: "2025-04"', 'tag: "2025-05"', 1))
    commit(branch)
    code, out, errors = check()
    name = "overrides/of-edge-object-detection-fusion-cf7e0180a8bb.yaml"
    assert (code, errors) == (1, f"error: {FUSION}: {LOST}, and merge {name} as shown\n")
    assert out == (
        f"\ninstead of editing {FUSION}, write {name}:\n"
        "\n"
        "# yaml-language-server: $schema=../schemas/override.json\n"
        "apiVersion: demandops/v1\n"
        "kind: Override\n"
        'reason: "Say here why you need this override; it replaces a manual edit of a generated '
        'file"\n'
        'owner: "Petra Platform"\n'
        "select:\n"
        "- applications:\n"
        "  - edge/object_detection_fusion\n"
        "  services:\n"
        "  - object-fusion\n"
        "values:\n"
        "  ros:\n"
        "    domainId: 7\n"
        "images:\n"
        "  object-fusion:\n"
        '    tag: "2025-05"\n'
        "replicas: 3\n"
    )


OTHER_EDITS: list[tuple[str, list[tuple[str, str]], dict[str, Any], list[str]]] = [
    (
        DETECTION,
        [("tolerations: []", "tolerations: [{key: gpu}]"), ("interval: 10m", "interval: 1m")],
        {"values": {"tolerations": [{"key": "gpu"}]}},
        ["spec.interval"],
    ),
    (
        DETECTION,
        [("tolerations: []", "tolerations: []\n    podAnnotations: {example.org/port: metrics}")],
        {"values": {"podAnnotations": {"example.org/port": "metrics"}}},
        [],
    ),
    (
        DETECTION,
        [('      digest: ""\n', ""), ("      rmwImplementation: ", "      other: ")],
        {
            "values": {
                "image": {"digest": None},
                "ros": {"rmwImplementation": None, "other": ""},
            }
        },
        [],
    ),
    (
        CLIENT,
        [("mqtt-client:2025-04", "mqtt-client:2026-01"), ("replicas: 1", "replicas: 2")],
        {"images": {"mqtt-client": {"tag": "2026-01"}}},
        ["Deployment spec.replicas"],
    ),
    (
        CLIENT,
        [
            (
                "docker.io/rwthika/robotkube-mqtt-client:2025-04",
                f"mirror.example:5000/mqtt@sha256:{'0' * 64}",
            )
        ],
        {
            "images": {
                "mqtt-client": {
                    "digest": f"sha256:{'0' * 64}",
                    "repository": "mirror.example:5000/mqtt",
                }
            }
        },
        [],
    ),
]


def test_other_edits_become_the_effect_that_is_made_for_them(
    branch: Path, found: Callable[..., dict[str, Any]]
) -> None:
    for path, replaced, effects, left in OTHER_EDITS:
        before = (branch / path).read_text()
        edit(branch / path, *replaced)
        (suggested,) = found()["suggestions"]
        (branch / path).write_text(before)
        override = yaml.safe_load(suggested["text"])
        head = ("apiVersion", "kind", "reason", "owner", "select")
        assert {key: override[key] for key in override if key not in head} == effects
        assert (suggested["instead_of"], suggested["not_covered"]) == (path, left)
        also = ["od-edge-vehicle00"] if path == DETECTION else []
        assert suggested["other_releases"] == also


def test_an_edit_that_no_override_does_is_refused_all_the_same(branch: Path, check: Run) -> None:
    version = ("object-detection-0.1.0", "object-detection-0.2.0")
    edit(branch / DETECTION, version, ("interval: 10m", "interval: 10m\n  suspend: true"))
    assert check()[1:] == ("", f"error: {DETECTION}: {LOST}, {BY_HAND}\n")
    (branch / DETECTION).write_text("kind: [\n")
    assert check()[0] == 1


def test_edits_of_generated_files_are_refused_with_the_remedy(branch: Path, check: Run) -> None:
    (branch / DETECTION).unlink()
    (branch / CLIENT).unlink()
    (branch / EDGE / "extra.yaml").write_text("kind: Secret\n")
    (branch / EDGE / "README.md").write_text("Ours.\n")
    (branch / "ledger" / "notes.yaml").write_text("a: b\n")
    (branch / "bootstrap").mkdir(exist_ok=True)
    (branch / "bootstrap" / "extra.yaml").write_text("a: b\n")
    (branch / ".demandops").mkdir()
    (branch / ".demandops" / "report.yaml").write_text("all: well\n")
    code, out, errors = check()
    assert code == 1
    stopped = "to stop the release, delete its claims in ledger/, or deny it by an override"
    assert errors.splitlines() == [
        "error: .demandops/report.yaml: is written by the generator, which would undo the edit; "
        "revert the edit",
        "error: bootstrap/extra.yaml: is in a generated folder, from which the generator removes "
        "other files; delete it",
        f"error: {EDGE}/extra.yaml: is in a generated folder, from which the generator removes "
        "what no demand needs; delete it, and demand what you need with `demandops request`",
        f"error: {DETECTION}: {LOST}; {stopped} (docs/overrides.md)",
        f"error: {CLIENT}: {LOST}; {stopped} (docs/overrides.md)",
        "error: ledger/notes.yaml: is not the path of a claim, and people may add only claims and "
        "waiting demands to ledger/; remove the file",
    ]
    assert out == ""


def test_an_override_that_is_there_is_not_overwritten_by_the_one_suggested(
    branch: Path, found: Callable[..., dict[str, Any]]
) -> None:
    (branch / "overrides").mkdir(exist_ok=True)
    (branch / "overrides" / "od-edge-station00.yaml").write_text(
        "apiVersion: demandops/v1\nkind: Override\nreason: r\nowner: o\n"
        "select: [{nodes: [cloud]}]\nhold: true\n"
    )
    edit(branch / DETECTION, ("tolerations: []", "tolerations: [{key: gpu}]"))
    assert found()["suggestions"][0]["file"] == "overrides/od-edge-station00-2.yaml"


# ---- claims and configuration, and what follows ----


def test_a_deleted_claim_is_no_fault_and_what_follows_is_shown(branch: Path, check: Run) -> None:
    (claim,) = claims(branch, "connection: vehicle00/edge")
    claim.unlink()
    commit(branch)
    base = git(branch, "rev-parse", "origin/main")[:10]
    source, target = Path(CLIENT).stem, "mqtt-vehicle00-edge-target-3c0f22bda69b"
    (need,) = (path.relative_to(branch) for path in claims(branch, f"application: {APP}"))
    missing = [
        f"{role} /vehicles/vehicle00/{topic} does not arrive: no connection carries it from "
        "'vehicle00' to 'edge'"
        for role, topic in (("ego_data", "ego_data"), ("point_cloud", "drivers/lidar/pointcloud"))
    ]
    assert check() == (
        0,
        f"{branch}: all files are valid and every release renders\n"
        "charts not rendered: helm is missing; install it and name it in HELM_BIN, "
        "or put it on PATH and leave HELM_BIN unset\n"
        "\n"
        f"what merging would do, compared with {base}:\n"
        "\n"
        "desired state:\n"
        f"  - {source} (MQTT source of connection vehicle00/edge on vehicle00)\n"
        f"  - {target} (MQTT target of connection vehicle00/edge on edge)\n"
        "\n"
        "bookkeeping:\n"
        "  - connection vehicle00/edge for station00, vehicle00\n"
        "\n"
        "the generator will write or remove 2 files:\n"
        f"  remove {EDGE}/{target}.yaml\n"
        f"  remove {CLIENT}\n",
        "".join(f"warning: {need}: application '{APP}': {each}\n" for each in missing),
    )


def test_an_edited_claim_is_judged_as_a_claim(
    branch: Path, check: Run, found: Callable[..., dict[str, Any]]
) -> None:
    (claim,) = claims(branch, "kind: ApplicationClaim")
    sound = claim.read_text()
    edit(claim, ("- station00\n", "- station00\n- tram07\n"))
    code, out, _ = check()
    assert code == 0
    assert "~ service od-edge-station00\n      + requester tram07\n" in out
    assert found()["files"] == []

    claim.write_text(sound.replace("node: edge", "node: moon"))
    path = claim.relative_to(branch).as_posix()
    faults = found()["faults"]
    assert {one["file"] for one in faults} == {path}
    assert any("'moon' is in use, but not in" in one["message"] for one in faults)

    claim.write_text(sound.replace("node: edge", "nodes: edge"))
    assert {one["file"] for one in found()["faults"]} == {path}


def test_all_faults_of_claims_configuration_and_hand_edits_are_told_together(
    branch: Path, found: Callable[..., dict[str, Any]]
) -> None:
    (claim,) = claims(branch, "kind: ApplicationClaim")
    edit(claim, ("node: edge", "nodes: edge"))
    edit(branch / "inventory" / "brokers.yaml", ("node: edge", "node: egde"))
    edit(branch / "policy" / "access-domains.yaml", ("kind: AccessDomains", "kind: Domains"))
    edit(branch / FUSION, ("replicas: 1", "replicas: 3"))
    data = found()
    assert {one["file"].split("/")[0] for one in data["faults"]} == {
        "ledger", "inventory", "policy", "clusters",
    }  # fmt: skip
    assert len(data["suggestions"]) == 1


def test_a_node_in_use_that_is_taken_away_is_told_with_how_to_give_it_up(
    branch: Path, found: Callable[..., dict[str, Any]]
) -> None:
    edit(branch / "inventory" / "nodes.yaml", ("- id: vehicle00\n", "- id: vehicle99\n"))
    told = [(one["file"], one["message"]) for one in found()["faults"]]
    assert (
        "inventory/nodes.yaml",
        "'vehicle00' is in use, but not in inventory/nodes.yaml; restore it there, or release all "
        "that uses it: demandops decommission vehicle00",
    ) in told


def test_configuration_shows_in_which_fields_releases_change(
    branch: Path, found: Callable[..., dict[str, Any]]
) -> None:
    edit(branch / "registry" / "images.yaml", *NEWER_PERCEPTION)
    data = found()
    assert [one["name"] for one in data["releases"]] == [
        "od-edge-station00", "od-edge-vehicle00", Path(FUSION).stem,
    ]  # fmt: skip
    assert data["releases"][0]["details"] == ["spec.values.image.tag: '2025-04' → '2025-09'"]
    assert '-      tag: "2025-04"\n+      tag: "2025-09"\n' in data["files"][0]["diff"]
    assert data["bookkeeping"] == []


def test_a_base_that_was_broken_is_mended_by_the_branch(
    bare: Path, branch: Path, found: Callable[..., dict[str, Any]]
) -> None:
    git(branch, "checkout", "--quiet", "main")
    edit(branch / "inventory" / "brokers.yaml", ("node: edge", "node: egde"))
    commit(branch, "A merge gone wrong")
    git(branch, "push", "--quiet", "origin", "main")
    git(branch, "checkout", "--quiet", "-b", "mend")
    edit(branch / "inventory" / "brokers.yaml", ("node: egde", "node: edge"))
    data = found()
    assert (data["faults"], data["base_valid"], data["files"]) == ([], False, [])


def test_a_symbolic_link_is_not_followed(
    branch: Path, tmp_path: Path, found: Callable[..., dict[str, Any]]
) -> None:
    secret = tmp_path / "secret"
    secret.write_text("password: hunter2\n")
    brokers = branch / "inventory" / "brokers.yaml"
    brokers.unlink()
    brokers.symlink_to(secret)
    data = found()
    assert {
        "code": "invalid",
        "file": "inventory/brokers.yaml",
        "field": "",
        "message": "is a symbolic link, which is not followed; replace it by a file",
        "line": None,
    } in data["faults"]
    assert "hunter2" not in json.dumps(data)


def test_the_check_of_another_render_version_says_so(
    branch: Path, check: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checking, "RENDER_VERSION", 3)
    assert check()[2] == (
        "error: demandops.yaml:15: renderVersion: is 2, but this program renders version 3; run "
        "this check with the same program version as the generator, or run `demandops upgrade` to "
        "render everything again\n"
    )


# ---- branches ----


def test_a_branch_of_several_commits_is_seen_whole_while_main_moves_on(
    bare: Path, branch: Path, found: Callable[..., dict[str, Any]]
) -> None:
    edit(branch / "registry" / "images.yaml", *NEWER_PERCEPTION)
    commit(branch)
    (claim,) = claims(branch, "connection: vehicle00/edge")
    claim.unlink()
    commit(branch)
    before = found()
    assert {one["change"] for one in before["releases"]} == {"change", "stop"}

    book(bare, "2-vehicle01-joins")
    git(branch, "fetch", "--quiet", "origin")
    assert found() == before
    git(branch, "merge", "--quiet", "--no-edit", "origin/main")
    after = found()
    assert (after["faults"], after["base"]) == ([], git(branch, "rev-parse", "origin/main"))
    assert {one["change"] for one in after["releases"]} == {"change", "stop"}
    assert not [one for one in after["bookkeeping"] if one["change"] == "added"]


def test_what_the_generator_wrote_itself_is_no_hand_edit(
    bare: Path, branch: Path, found: Callable[..., dict[str, Any]]
) -> None:
    old = git(branch, "rev-parse", "HEAD")
    book(bare, "2-vehicle01-joins")
    git(branch, "pull", "--quiet", "origin", "main")
    data = found("--base", old)
    assert data["faults"] == []
    assert "start" in {one["change"] for one in data["releases"]}


def test_without_a_remote_main_is_compared_with(
    branch: Path, found: Callable[..., dict[str, Any]]
) -> None:
    git(branch, "remote", "remove", "origin")
    edit(branch / "registry" / "images.yaml", *NEWER_PERCEPTION)
    commit(branch)
    assert len(found()["releases"]) == 3
    assert found("--base", "HEAD")["releases"] == found()["releases"]  # no generator has followed


SHALLOW = (
    "this clone is shallow and lacks the commit that the edit started from; fetch all commits: "
    "git fetch --unshallow origin (in a pipeline, set fetch-depth: 0 or GIT_DEPTH: 0)"
)


@pytest.mark.parametrize("base", [[], ["--base", "origin/main"]], ids=["default", "named"])
def test_a_shallow_clone_is_told_how_to_become_whole(
    bare: Path,
    branch: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    base: list[str],
) -> None:
    (claim,) = claims(branch, "connection: vehicle00/edge")
    claim.unlink()
    commit(branch)
    git(branch, "push", "--quiet", "origin", "edit")
    folder = tmp_path / "shallow"
    git(tmp_path, "clone", "-q", "--depth", "1", "--branch", "edit", bare.as_uri(), str(folder))
    capsys.readouterr()
    assert run(["check", str(folder), *base]) == 1
    named = "'origin/main': " if base else ""
    assert capsys.readouterr() == ("", f"error: {named}{SHALLOW}\n")
    git(folder, "fetch", "--quiet", "origin", "+refs/heads/main:refs/remotes/origin/main")
    assert run(["check", str(folder), *base]) == 1
    assert SHALLOW in capsys.readouterr().err
    git(folder, "fetch", "--quiet", "--unshallow", "origin")
    assert run(["check", str(folder), *base]) == 0


def test_a_sparse_checkout_is_told_how_to_become_whole(branch: Path, check: Run) -> None:
    git(branch, "sparse-checkout", "set", "policy")
    message = f"{branch} is a sparse checkout, which lacks files; check out all files with "
    assert check() == (1, "", f"error: {message}`git sparse-checkout disable`\n")
    git(branch, "sparse-checkout", "disable")
    assert check().code == 0


def test_a_checkout_that_git_cannot_open_is_not_taken_for_files_without_git(
    branch: Path, demandops: Run
) -> None:
    """Git cannot open a checkout of another user, nor a work tree whose repository is missing."""
    shutil.rmtree(branch / ".git")
    (branch / ".git").write_text("gitdir: /nowhere\n")
    told = f"error: {branch} is a Git repository that cannot be opened: "
    remedy = f"run `git config --global --add safe.directory {branch}`"
    for command in (["check"], ["get", "nodes", "--state-repo"]):
        code, out, errors = demandops(*command, branch)
        assert (code, out) == (1, "")
        assert errors.startswith(told)
        assert errors.rstrip().endswith(remedy)


@pytest.mark.parametrize(
    "base", ["nowhere", ":/", "HEAD^{/(.*)*}", "origin/main@{1}", "-x", "\udcff"]
)
def test_a_base_of_another_kind_is_refused(branch: Path, check: Run, base: str) -> None:
    code, out, errors = check("--base", base)
    assert (code, out) == (1, "")
    assert "is neither a commit of the state repo nor a time" in errors


def test_a_base_that_is_none_is_told(branch: Path, check: Run) -> None:
    code, out, errors = check("--base", "nowhere")
    assert (code, out) == (1, "")
    assert errors.startswith("error: 'nowhere' is neither a commit")
    git(branch, "checkout", "--quiet", "--orphan", "alone")
    commit(branch)
    assert check()[2] == (
        "error: HEAD and refs/remotes/origin/main have no commit in common; name the merge "
        "target with --base\n"
    )


# ---- Markdown ----


def test_the_report_is_ready_to_be_posted(branch: Path, check: Run) -> None:
    edit(branch / "registry" / "images.yaml", *NEWER_PERCEPTION)
    (claim,) = claims(branch, "connection: vehicle00/edge")
    claim.unlink()
    edit(branch / DETECTION, ("tolerations: []", "tolerations: [{key: gpu}]"))
    commit(branch)
    code, out, errors = check("--output", "markdown")
    assert (code, errors) == (1, "")
    report = out.replace(git(branch, "rev-parse", "origin/main")[:10], "0123456789")
    assert report == GOLDEN.read_text()


def test_a_report_of_nothing_says_so(branch: Path, check: Run) -> None:
    base = git(branch, "rev-parse", "HEAD")[:10]
    assert check("--output", "markdown") == (
        0,
        "<!-- demandops check -->\n"
        "## DemandOps: valid, and every release renders\n"
        "\ncharts not rendered: helm is missing; install it and name it in HELM_BIN, "
        "or put it on PATH and leave HELM_BIN unset\n"
        f"\nCompared with `{base}`.\n"
        "\nMerging changes no release and no demand.\n",
        "",
    )


def test_what_people_wrote_cannot_act_in_a_comment(branch: Path, check: Run) -> None:
    evil = "`@everyone` </details> [x](javascript:0) ```` ![i](http://x) <b>|"
    (claim,) = claims(branch, "kind: ApplicationClaim")
    text = yaml.safe_load(claim.read_text())
    claim.write_text(json.dumps(text | {"requesters": [evil]}))
    (branch / EDGE / "a&<b>`.yaml").write_text("x")
    code, out, _ = check("--output", "markdown")
    assert code == 1
    assert f"`````requester {evil}`````" in out
    outside = without_code(out)
    for mark in ("@", "javascript", "http:", "<b>", "]("):
        assert mark not in outside


def test_why_a_chart_is_not_rendered_cannot_act_in_a_comment() -> None:
    charts = RenderedCharts(not_rendered={"cam": "its dependency @everyone is not in charts/"})
    comment = report(CheckResult((), charts=charts))
    told = "\nchart cam not rendered: `its dependency @everyone is not in charts/`\n"
    assert told in comment


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
    (claim,) = claims(branch, "kind: ApplicationClaim")
    crowd = [f"vehicle-{number:05}" for number in range(4_000)]
    claim.write_text(json.dumps(yaml.safe_load(claim.read_text()) | {"requesters": crowd}))
    edit(branch / "registry" / "images.yaml", *NEWER_PERCEPTION)
    code, out, _ = check("--output", "markdown")
    assert code == 0
    assert len(out) <= LONGEST == 60_000
    assert out.startswith(f"{MARK}\n## DemandOps: valid")
    assert "Releases: 3 to change." in out
    assert out.endswith(
        "\n3 parts of this report are left out because a comment has a limited length; "
        "`demandops check --output json` has more.\n"
    )
