"""`demandops check` compares what a person is about to merge with the commit they started from."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from demandops.cli.main import run

from tests.kit.cli import Run
from tests.kit.goals import EXPERIMENT, put
from tests.kit.repo import GitRepo, git

CHART = "appdefs/object-detection-fusion/charts/object-fusion"


NEW_CHART = """\
# ChartVersion, not Revision: a commit that leaves the chart alone must not touch its releases.
apiVersion: source.toolkit.fluxcd.io/v1
kind: HelmChart
metadata:
  name: "object-fusion-0.2.0"
  namespace: "perception"
spec:
  interval: 10m
  chart: "./appdefs/object-detection-fusion/charts/object-fusion"
  reconcileStrategy: ChartVersion
  sourceRef:
    kind: GitRepository
    name: "demandops"
"""
NO_HELM = (
    "charts not rendered: helm is missing; install it and name it in HELM_BIN, or put it on PATH "
    "and leave HELM_BIN unset\n"
)
LINK: dict[str, object] = {"id": "a/link", "type": "mqtt", "source": "vehicle00", "target": "edge"}
LINK |= {"topics": [{"source": "/a"}]}
Check = Callable[..., tuple[int, str, str]]


@pytest.fixture
def check(checkout: Path, demandops: Run) -> Check:
    def checked(*args: str) -> tuple[int, str, str]:
        code, out, err = demandops("check", checkout, *args)
        return code, out.replace(f"{checkout}", "REPO").replace(head(checkout)[:10], "BASE"), err

    return checked


def head(folder: Path) -> str:
    return git(folder, "rev-parse", "HEAD") if (folder / ".git").exists() else "0" * 40


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_what_init_laid_down_is_sound(check: Check) -> None:
    assert check() == (0, "REPO: all files are valid and every release renders\n" + NO_HELM, "")


def test_a_pipeline_may_require_helm(check: Check) -> None:
    code, out, errors = check("--require-helm")
    assert (code, out.splitlines()[:1]) == (1, [])
    assert errors == (
        "error: charts not rendered: helm is missing; install it and name it in HELM_BIN, "
        "or put it on PATH and leave HELM_BIN unset\n"
    )


def test_a_changed_library_needs_new_versions_of_its_charts(checkout: Path, check: Check) -> None:
    library = "appdefs/charts/ros-service"
    edit(checkout / library / "values.yaml", "domainId: 0", "domainId: 1")
    code, _, errors = check()
    assert code == 1
    assert errors == "".join(
        f"error: {folder}/{chart}/Chart.yaml:5: version: is still 0.1.0, but {library}/values.yaml "
        f"changed; raise the version here and at charts.{chart} in registry/charts.yaml, or no "
        "cluster applies the change\n"
        for folder in ["appdefs/object-detection-fusion/charts"]
        for chart in ("object-detection", "object-fusion")
    )


def test_a_chart_that_changed_without_a_new_version_is_caught(checkout: Path, check: Check) -> None:
    edit(checkout / CHART / "values.yaml", "period: 0.5", "period: 0.7")
    code, _, errors = check()
    assert code == 1
    assert errors == (
        f"error: {CHART}/Chart.yaml:5: version: is still 0.1.0, but values.yaml changed; raise "
        "the version here and at charts.object-fusion in registry/charts.yaml, or no cluster "
        "applies the change\n"
    )


def test_a_chart_that_changed_with_a_new_version_is_fine_and_shows_what_follows(
    checkout: Path, check: Check
) -> None:
    edit(checkout / CHART / "values.yaml", "period: 0.5", "period: 0.7")
    edit(checkout / CHART / "Chart.yaml", "version: 0.1.0", "version: 0.2.0")
    charts = checkout / "registry" / "charts.yaml"
    charts.write_text("0.2.0".join(charts.read_text().rsplit("0.1.0", 1)))
    code, out, errors = check()
    assert (code, errors) == (0, "")
    assert out == (
        f"REPO: all files are valid and every release renders\n{NO_HELM}"
        "\n"
        "what merging would do, compared with BASE:\n"
        "\n"
        "the generator will write or remove 2 files:\n"
        "  remove clusters/c-its/perception/_charts/object-fusion-0.1.0.yaml\n"
        "  write  clusters/c-its/perception/_charts/object-fusion-0.2.0.yaml\n"
        "\n"
        "--- /dev/null\n"
        "+++ clusters/c-its/perception/_charts/object-fusion-0.2.0.yaml\n"
        "@@ -0,0 +1,13 @@\n" + "".join(f"+{line}\n" for line in NEW_CHART.splitlines())
    )


def test_a_generated_file_edited_by_hand_is_told(checkout: Path, check: Check) -> None:
    edit(checkout / "bootstrap" / "c-its.yaml", "prune: true", "prune: false")
    code, _, errors = check()
    assert code == 1
    assert errors == (
        "error: bootstrap/c-its.yaml: is generated, so a manual edit is lost; revert it, and "
        "change demandops.yaml, inventory/ or policy/ instead\n"
    )


def test_a_folder_that_is_no_git_checkout_is_checked_all_the_same(
    checkout: Path, check: Check
) -> None:
    shutil.rmtree(checkout / ".git")
    assert check()[0] == 0
    edit(checkout / "inventory" / "nodes.yaml", "cluster: c-its", "cluster: c-itz")
    assert check()[0] == 1
    code, _, errors = check("--base", "HEAD")
    assert (code, errors) == (1, f"error: {checkout} is not a Git checkout; leave out --base\n")


def test_check_warns_of_an_input_that_the_branch_cuts_off(
    state: GitRepo, tmp_path: Path, demandops: Run
) -> None:
    assert demandops("request", EXPERIMENT[0], "--state-repo", state.path).code == 0
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", str(state.path), str(clone))
    (clone / "overrides" / "rest.yaml").write_text(
        "apiVersion: demandops/v1\nkind: Override\nreason: why\nowner: petra\n"
        "select: [{connections: [vehicle00/edge]}]\ndeny: true\n"
    )
    ran = demandops("check", clone)
    told = [line for line in ran.err.splitlines() if "does not arrive" in line]
    assert len(told) == 2
    assert told[0].startswith("warning: ledger/applications/")
    git(clone, "add", "--all")
    git(clone, "commit", "--quiet", "--message=Rest")
    git(clone, "push", "--quiet")
    assert "does not arrive" not in demandops("check", clone).err, (
        "an input that the branch did not change must not be told"
    )


def test_what_the_merge_target_has_already_is_no_consequence(
    state: GitRepo, tmp_path: Path, demandops: Run
) -> None:
    files = state.files()
    state.commit(
        {
            "inventory/clusters.yaml": files["inventory/clusters.yaml"] + "  - name: other\n",
            "inventory/nodes.yaml": files["inventory/nodes.yaml"].replace(
                "type: cloud\n    cluster: c-its", "type: cloud\n    cluster: other"
            ),
        }
    )
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", str(state.path), str(clone))
    written = "the generator will write or remove"
    assert written in demandops("check", clone).out
    given = yaml.safe_dump(put("a", "vehicle00", applications=[], connections=[LINK]))
    assert demandops("request", "-", "--state-repo", state.path, stdin=given).code == 0
    git(clone, "fetch", "--quiet")
    out = demandops("check", clone).out
    assert written not in out
    lacks = "the merge target has 2 commits that this checkout lacks: "
    assert f"{lacks}git rebase --autostash origin/main\n" in out
    git(clone, "checkout", "--quiet", "-b", "topic")
    git(clone, *out.partition(lacks)[2].splitlines()[0].split()[1:])  # the remedy works
    assert lacks not in demandops("check", clone).out


def test_a_folder_that_is_no_state_repo(demandops: Run, tmp_path: Path) -> None:
    said = (
        f"error: {tmp_path} is not a state repo, because it has no demandops.yaml; name a "
        "checkout of one, or make one with `demandops init`\n"
    )
    assert demandops("check", tmp_path) == (1, "", said)


def test_a_bare_repository_has_nothing_to_check(demandops: Run, state: GitRepo) -> None:
    assert demandops("check", state.path) == (
        1,
        "",
        f"error: {state.path} is a bare repository, which has no files to edit; clone it, and use "
        f"the clone: git clone {state.path}\n",
    )


def test_json_names_file_field_and_message(checkout: Path, check: Check) -> None:
    edit(checkout / "inventory" / "brokers.yaml", "node: edge", "node: egde")
    text = (checkout / "inventory" / "brokers.yaml").read_text()
    line = text[: text.index("egde")].count("\n") + 1
    code, out, _ = check("--output", "json")
    assert code == 1
    found = json.loads(out)
    assert found["faults"] == [
        {
            "code": "invalid",
            "file": "inventory/brokers.yaml",
            "field": "brokers[1].node",
            "message": "'egde' is not in nodes.yaml; did you mean 'edge'?",
            "line": line,
        }
    ]
    assert (found["releases"], found["files"], found["bookkeeping"]) == (None, None, None)


def test_a_person_may_not_change_the_generators_reports(checkout: Path, check: Check) -> None:
    """`check` accepts a report that is committed, and refuses its deletion by a person."""
    report = checkout / ".demandops" / "reports" / "problems.yaml"
    report.parent.mkdir(parents=True)
    report.write_text("problems: []\n")
    git(checkout, "add", "--all")
    git(checkout, "commit", "-qm", "Report what is not valid in the state repo")
    assert check() == (0, "REPO: all files are valid and every release renders\n" + NO_HELM, "")
    report.unlink()
    code, _, err = check()
    assert code == 1
    assert err.startswith("error: .demandops/reports/problems.yaml: is written by the generator")


def test_an_application_definition_that_is_in_use_cannot_be_deleted(
    checkout: Path, check: Check
) -> None:
    goal = checkout.parent / "goal.yaml"
    goal.write_text(json.dumps(put("d")))
    bare = checkout.parent / "state.git"
    git(checkout.parent, "clone", "-q", "--bare", str(checkout), str(bare))
    assert run(["request", str(goal), "--state-repo", str(bare)]) == 0
    git(checkout, "pull", "-q", str(bare), "main")
    (checkout / "appdefs" / "object-detection-fusion" / "appdef.yaml").unlink()
    code, _, err = check()
    assert code == 1
    assert "'object-detection-fusion' is in use, but appdefs/object-detection-fusion is gone" in err


def test_a_first_bootstrap_is_told_and_not_printed(checkout: Path, check: Check) -> None:
    clusters, nodes = (checkout / "inventory" / f"{name}.yaml" for name in ("clusters", "nodes"))
    clusters.write_text(clusters.read_text() + "  - name: c9\n")
    nodes.write_text(nodes.read_text() + "  - {id: v9, type: vehicle, cluster: c9}\n")
    code, out, errors = check()
    assert code == 0
    assert (
        "warning: bootstrap/c9.yaml: is new with the merge, but no controller applies bootstrap "
        "files; "
    ) in errors
    assert "  write  bootstrap/c9.yaml (new, " in out
    assert "kind: Namespace" not in out


def test_a_merge_that_changes_what_someone_applied_says_so(checkout: Path, check: Check) -> None:
    policy = checkout / "policy" / "access-domains.yaml"
    kinds = "ConfigMap, Deployment, HorizontalPodAutoscaler, Secret"
    policy.write_text(policy.read_text() + f"    kinds: [{kinds}]\n")
    code, _, errors = check()
    assert code == 0
    charts = "appdefs/object-detection-fusion/charts"
    assert [re.sub(r":\d+$", "", line.split(": ")[1]) for line in errors.splitlines()] == [
        "appdefs/charts/ros-service/templates/_serviceaccount.yaml",
        *[f"{charts}/object-fusion/templates/watcher-rbac.yaml"] * 2,
        "bootstrap/c-its.yaml",
    ]
    assert errors.splitlines()[-1] == (
        "warning: bootstrap/c-its.yaml: changes with the merge, but no controller applies "
        "bootstrap files; after the merge, an administrator of cluster 'c-its' must run: "
        "git show main:bootstrap/c-its.yaml | kubectl apply -f -"
    )
