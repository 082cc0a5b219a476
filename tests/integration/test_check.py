"""`demandops check` compares what a person is about to merge with the commit they started from.

See ``test_pull_requests.py`` for branches of a state repo in which a demand is booked.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.integration.conftest import On
from tests.kit.cli import Ran, Run
from tests.kit.config import override
from tests.kit.goals import EXPERIMENT, put
from tests.kit.repo import GitRepo, git

CHARTS, LIBRARY = "appdefs/object-detection-fusion/charts", "appdefs/charts/ros-service"
CHART = f"{CHARTS}/object-fusion"
VALID = "all files are valid and every release renders\n"
NO_HELM = "charts not rendered: helm is missing"
LINK: dict[str, object] = {"id": "a/link", "type": "mqtt", "source": "vehicle00", "target": "edge"}
LINK |= {"topics": [{"source": "/a"}]}
Check = Callable[..., Ran]


@pytest.fixture
def check(checkout: Path, demandops: Run) -> Check:
    return lambda *args: demandops("check", checkout, *args)


@pytest.fixture
def clone(state: GitRepo, tmp_path: Path) -> Callable[[], Path]:
    def cloned() -> Path:
        git(tmp_path, "clone", "--quiet", str(state.path), "clone")
        return tmp_path / "clone"

    return cloned


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_what_init_laid_down_is_sound(checkout: Path, check: Check) -> None:
    ran = check()
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith(f"{checkout}: {VALID}{NO_HELM}")
    required = check("--require-helm")
    assert (required.code, required.out) == (1, "")
    assert required.err.startswith(f"error: {NO_HELM}")


@pytest.mark.parametrize(
    ("changed", "old", "charts"),
    [
        (f"{LIBRARY}/values.yaml", "domainId: 0", ("object-detection", "object-fusion")),
        (f"{CHART}/values.yaml", "period: 0.5", ("object-fusion",)),
    ],
    ids=["a library", "a chart"],
)
def test_what_changed_needs_new_versions_of_its_charts(
    checkout: Path, check: Check, changed: str, old: str, charts: tuple[str, ...]
) -> None:
    edit(checkout / changed, old, f"{old}9")
    ran = check()
    assert ran.code == 1
    for told, chart in zip(ran.err.splitlines(), charts, strict=True):
        file = changed.removeprefix(f"{CHARTS}/{chart}/")
        assert told.startswith(
            f"error: {CHARTS}/{chart}/Chart.yaml:5: version: is still 0.1.0, but {file} changed; "
        )
        assert f" charts.{chart} in registry/charts.yaml" in told


def test_a_chart_that_changed_with_a_new_version_is_fine_and_shows_what_follows(
    checkout: Path, check: Check
) -> None:
    edit(checkout / CHART / "values.yaml", "period: 0.5", "period: 0.7")
    edit(checkout / CHART / "Chart.yaml", "version: 0.1.0", "version: 0.2.0")
    charts = checkout / "registry" / "charts.yaml"
    charts.write_text("0.2.0".join(charts.read_text().rsplit("0.1.0", 1)))
    ran = check()
    assert (ran.code, ran.err) == (0, "")
    follows = ran.out.split(f"compared with {git(checkout, 'rev-parse', 'HEAD')[:10]}:\n\n")[1]
    old, new = (
        f"clusters/c-its/perception/_charts/object-fusion-0.{minor}.0.yaml" for minor in (1, 2)
    )
    told, _, diff = follows.partition("\n\n")
    assert told == f"the generator will write or remove 2 files:\n  remove {old}\n  write  {new}"
    assert diff.startswith(f"--- /dev/null\n+++ {new}\n")
    assert '\n+  name: "object-fusion-0.2.0"\n' in diff


def test_a_folder_that_is_no_git_checkout_is_checked_all_the_same(
    checkout: Path, check: Check
) -> None:
    shutil.rmtree(checkout / ".git")
    assert check().code == 0
    edit(checkout / "inventory" / "nodes.yaml", "cluster: c-its", "cluster: c-itz")
    assert check().code == 1
    ran = check("--base", "HEAD")
    assert (ran.code, ran.out) == (1, "")
    assert "is not a Git checkout; leave out --base" in ran.err


def test_check_warns_of_an_input_that_the_branch_cuts_off(
    on: On, clone: Callable[[], Path], demandops: Run
) -> None:
    assert on("request", EXPERIMENT[0]).code == 0
    folder = clone()
    text = override({"connections": ["vehicle00/edge"]}, deny=True)
    (folder / "overrides" / "rest.yaml").write_text(text)
    ran = demandops("check", folder)
    told = [line for line in ran.err.splitlines() if "does not arrive" in line]
    assert len(told) == 2
    assert told[0].startswith("warning: ledger/applications/")
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message=Rest")
    git(folder, "push", "--quiet")
    ran = demandops("check", folder)
    assert "does not arrive" not in ran.err, "the branch changes nothing of this input"


def test_what_the_merge_target_has_already_is_no_consequence(
    on: On, state: GitRepo, clone: Callable[[], Path], demandops: Run
) -> None:
    files = state.files()
    cloud = "type: cloud\n    cluster: "
    nodes = files["inventory/nodes.yaml"].replace(f"{cloud}c-its", f"{cloud}other")
    clusters = files["inventory/clusters.yaml"] + "  - name: other\n"
    state.commit({"inventory/clusters.yaml": clusters, "inventory/nodes.yaml": nodes})
    folder, written = clone(), "the generator will write or remove"
    assert written in demandops("check", folder).out
    on.book(put("a", "vehicle00", applications=[], connections=[LINK]))
    git(folder, "fetch", "--quiet")
    out = demandops("check", folder).out
    assert written not in out
    lacks = "the merge target has 2 commits that this checkout lacks: "
    assert f"{lacks}git rebase --autostash origin/main\n" in out
    git(folder, "checkout", "--quiet", "-b", "topic")
    git(folder, *out.partition(lacks)[2].splitlines()[0].split()[1:])  # the remedy works
    assert lacks not in demandops("check", folder).out


def test_what_has_no_files_to_check(demandops: Run, tmp_path: Path, bare: Path) -> None:
    for folder, told in (
        (tmp_path, " is not a state repo, because it has no demandops.yaml; "),
        (bare, f" is a bare repository, which has no files to edit; clone it"),
    ):
        ran = demandops("check", folder)
        assert (ran.code, ran.out) == (1, "")
        assert ran.err.startswith(f"error: {folder}{told}")


def test_json_names_file_field_and_message(checkout: Path, check: Check) -> None:
    brokers = checkout / "inventory" / "brokers.yaml"
    edit(brokers, "node: edge", "node: egde")
    text = brokers.read_text()
    ran = check("--output", "json")
    assert ran.code == 1
    found = ran.json()
    assert found["faults"] == [
        {
            "code": "invalid",
            "file": "inventory/brokers.yaml",
            "field": "brokers[1].node",
            "message": "'egde' is not in nodes.yaml; did you mean 'edge'?",
            "line": text[: text.index("egde")].count("\n") + 1,
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
    assert check().code == 0
    report.unlink()
    ran = check()
    assert ran.code == 1
    assert ran.err.startswith(
        "error: .demandops/reports/problems.yaml: is written by the generator"
    )


def test_an_application_definition_that_is_in_use_cannot_be_deleted(
    on: On, clone: Callable[[], Path], demandops: Run
) -> None:
    on.book(put("d"))
    folder = clone()
    (folder / "appdefs" / "object-detection-fusion" / "appdef.yaml").unlink()
    ran = demandops("check", folder)
    assert ran.code == 1
    assert "'object-detection-fusion' is in use, but appdefs/object-detection-fusion is" in ran.err


def test_a_first_bootstrap_is_told_and_not_printed(checkout: Path, check: Check) -> None:
    for name, added in (
        ("clusters", "name: c9"),
        ("nodes", "{id: v9, type: vehicle, cluster: c9}"),
    ):
        with (checkout / "inventory" / f"{name}.yaml").open("a") as file:
            file.write(f"  - {added}\n")
    ran = check()
    assert ran.code == 0
    assert "warning: bootstrap/c9.yaml: is new with the merge" in ran.err
    assert "  write  bootstrap/c9.yaml (new, " in ran.out
    assert "kind: Namespace" not in ran.out


def test_a_merge_that_changes_what_someone_applied_says_so(checkout: Path, check: Check) -> None:
    with (checkout / "policy" / "access-domains.yaml").open("a") as policy:
        policy.write("    kinds: [ConfigMap, Deployment, HorizontalPodAutoscaler, Secret]\n")
    ran = check()
    assert ran.code == 0
    assert [re.sub(r":\d+$", "", line.split(": ")[1]) for line in ran.err.splitlines()] == [
        f"{LIBRARY}/templates/_serviceaccount.yaml",
        *[f"{CHART}/templates/watcher-rbac.yaml"] * 2,
        "bootstrap/c-its.yaml",
    ]
    last = ran.err.splitlines()[-1]
    assert "changes with the merge" in last
    assert last.endswith(" git show main:bootstrap/c-its.yaml | kubectl apply -f -")
