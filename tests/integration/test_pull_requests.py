"""`demandops check` on pull requests: branches of a state repo in which a demand is booked.

More is in ``stories/check.yaml`` and ``stories/checkouts.yaml``.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml
from demandops.cli.authoring.check import LONGEST, MARK, report
from demandops.cli.main import run
from demandops.repo.merge_check.merge_check import CheckResult
from demandops.repo.merge_check.rendered_charts import RenderedCharts
from markdown_it import MarkdownIt

from tests.integration.conftest import On
from tests.kit import plain_yaml
from tests.kit.cli import Run
from tests.kit.goals import EXPERIMENT, perception
from tests.kit.repo import git, hook

HERE = Path(__file__).parent
EDITS = plain_yaml.load((HERE / "edits.yaml").read_text())
EDGE = "clusters/c-its/perception/edge"
DETECTION = f"{EDGE}/od-edge-station00.yaml"
FUSION = f"{EDGE}/of-edge-object-detection-fusion-cf7e0180a8bb.yaml"
LOST = "is generated, so a manual edit is lost; revert it"


@pytest.fixture(scope="session")
def bare_template(bare_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bare state repo in which vehicle00's demand is booked."""
    folder = Path(shutil.copytree(bare_template, tmp_path_factory.mktemp("booked") / "state.git"))
    assert run(["request", str(EXPERIMENT[0]), "--state-repo", str(folder)]) == 0
    return folder


@pytest.fixture
def branch(bare: Path, tmp_path: Path) -> Path:
    """A clone of the state repo."""
    git(tmp_path, "clone", "--quiet", "--no-local", str(bare), "clone")
    return tmp_path / "clone"


@pytest.fixture
def check(branch: Path, demandops: Run) -> Run:
    return lambda *args: demandops("check", branch, *args)


def edit(file: Path, replaced: dict[str, str]) -> None:
    text = file.read_text()
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    file.write_text(text)


def claim(folder: Path, needle: str = "\napplication:\n") -> Path:
    files = (folder / "ledger").rglob("*.yaml")
    (found,) = [path for path in files if needle in path.read_text()]
    return found


def with_requesters(branch: Path, names: list[str]) -> None:
    file = claim(branch)
    file.write_text(json.dumps(yaml.safe_load(file.read_text()) | {"requesters": names}))


# # ---- manual edits ----


def test_an_edit_becomes_an_override_to_paste(branch: Path, check: Run) -> None:
    for case in EDITS:
        path, name = case["path"], f"overrides/{Path(case['path']).name}"
        edit(branch / path, case["edit"])
        (suggested,) = check("--output", "json").json()["suggestions"]
        ran = check()
        git(branch, "checkout", "--quiet", ".")
        assert ran.code == 1
        assert ran.err.startswith(f"error: {path}: {LOST}, and merge {name} as shown")
        shown = f"\ninstead of editing {path}, write {name}:\n\n"
        assert ran.out.startswith(shown) and suggested["text"] in ran.out
        made = yaml.safe_load(suggested["text"])
        effects = {key: made[key] for key in ("values", "images", "replicas") if key in made}
        assert effects == case["effects"]
        assert made["select"] == case.get("select", made["select"])
        for key in ("not_covered", "other_releases"):
            assert suggested[key] == case.get(key, [])


@pytest.mark.parametrize("gitops", ["flux", "argocd"])
def test_the_override_suggested_gives_the_file_that_was_edited_by_hand(
    on: On, branch: Path, check: Run, gitops: str
) -> None:
    assert on("upgrade", "--gitops", gitops).code == 0
    git(branch, "pull", "--quiet")
    edit(branch / FUSION, {"domainId: 0": "domainId: 7", "replicas: 1": "replicas: 3"})
    edited = (branch / FUSION).read_text()
    (suggested,) = check("--output", "json").json()["suggestions"]
    on.state.commit({suggested["file"]: suggested["text"]})
    on.book(perception(id="second"))
    written = on.state.files()[FUSION]
    assert [*yaml.safe_load_all(written)] == [*yaml.safe_load_all(edited)]


def test_git_runs_no_program_of_the_checkout_and_writes_nothing_into_it(
    branch: Path, check: Run
) -> None:
    file = hook(branch, "post-index-change", "touch ran")
    git(branch, "update-index", "--split-index")
    options = {"splitIndex": "true", "fsmonitor": str(file), "hooksPath": "hooks"}
    for name, value in options.items():
        git(branch, "config", f"core.{name}", value)
    edit(branch / "registry" / "images.yaml", {"tag: 2025-04": "tag: 2025-09"})
    before = {path: path.read_bytes() for path in branch.rglob("*") if path.is_file()}
    assert check().code == 0
    assert {path: path.read_bytes() for path in branch.rglob("*") if path.is_file()} == before


# ---- Markdown ----


def test_the_report_is_ready_to_be_posted(branch: Path, check: Run) -> None:
    base = git(branch, "rev-parse", "origin/main")[:10]
    ran = check("--output", "markdown")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith(f"{MARK}\n## DemandOps: valid, and every release renders\n")
    assert ran.out.endswith(f"`{base}`.\n\nMerging changes no release and no demand.\n")
    names = ("object-detection", "object-fusion", "k8s-configmap-watcher")
    newer = {f"{name}\n    tag: 2025-04": f"{name}\n    tag: 2025-09" for name in names}
    edit(branch / "registry" / "images.yaml", newer)
    claim(branch, "connection:\n  id: vehicle00/edge").unlink()
    edit(branch / DETECTION, {"tolerations: []": "tolerations: [{key: gpu}]"})
    git(branch, "commit", "--quiet", "--all", "-m", "An edit")
    ran = check("--output", "markdown")
    assert (ran.code, ran.err) == (1, "")
    assert ran.out.replace(base, "0123456789") == (HERE / "pull-request.md").read_text()


def test_what_people_wrote_cannot_act_in_a_comment(branch: Path, check: Run) -> None:
    evil = "`@everyone` </details> [x](javascript:0) ```` ![i](http://x) <b>|"
    with_requesters(branch, [evil])
    (branch / EDGE / "a&<b>`.yaml").write_text("x")
    ran = check("--output", "markdown")
    assert ran.code == 1
    assert f"    + requester {evil}\n`````" in ran.out
    inner = [each for token in MarkdownIt().parse(ran.out) for each in token.children or [token]]
    outside = "".join(each.content for each in inner if each.type not in ("code_inline", "fence"))
    assert not [each.type for each in inner if each.type in ("link_open", "image")]
    assert not [mark for mark in ("@", "javascript", "http:", "<b>") if mark in outside]
    charts = RenderedCharts(not_rendered={"cam": "its dependency @everyone is not in charts/"})
    comment = report(CheckResult((), charts=charts))
    assert "\nchart cam not rendered: `its dependency @everyone is not in charts/`\n" in comment


def test_a_report_is_never_longer_than_a_comment_may_be(branch: Path, check: Run) -> None:
    with_requesters(branch, [f"vehicle-{number:05}" for number in range(4_000)])
    edit(
        branch / "registry" / "images.yaml",
        {"detection\n    tag: 2025-04": "detection\n    tag: x"},
    )
    ran = check("--output", "markdown")
    assert ran.code == 0
    assert len(ran.out) <= LONGEST == 60_000
    assert ran.out.startswith(f"{MARK}\n## DemandOps: valid")
    assert "~ od-edge-station00" in ran.out and "\n…\n" in ran.out
    assert "\nParts cut or left out, because a comment has a limited length: " in ran.out[-200:]
