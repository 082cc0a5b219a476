"""For a manual edit, `check` suggests an override; `upgrade` respects overrides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.kit.config import override
from tests.kit.goals import perception
from tests.kit.repo import git

Run = Callable[..., Any]
EDGE = "clusters/c-its/perception/edge"
FUSION = f"{EDGE}/of-edge-object-detection-fusion-cf7e0180a8bb.yaml"
CLIENT = "clusters/c-its/perception/vehicle00/mqtt-vehicle00-edge-source-d3ca91c2df6c.yaml"


@pytest.fixture
def book(demandops: Run, state: Any) -> Callable[..., Any]:
    def call(**options: Any) -> Any:
        goal = yaml.safe_dump(perception(**options))
        ran = demandops("request", "-", "--state-repo", state.path, stdin=goal)
        assert ran.code == 0, ran.err
        return ran

    return call


@pytest.fixture
def clone(state: Any, book: Callable[..., Any], tmp_path: Path) -> Path:
    book()
    git(tmp_path, "clone", "--quiet", str(state.path), "clone")
    return tmp_path / "clone"


def bodies(text: str) -> list[Any]:
    return list(yaml.safe_load_all(text))


@pytest.mark.parametrize(
    ("path", "replaced", "gitops"),
    [
        (FUSION, [("domainId: 0", "domainId: 7"), ("replicas: 1", "replicas: 3")], "flux"),
        (FUSION, [("domainId: 0", "domainId: 7"), ("replicas: 1", "replicas: 3")], "argocd"),
        (CLIENT, [("mqtt-client:2025-04", "mqtt-client:2026-01")], "flux"),
    ],
    ids=["values-and-replicas", "with-argocd", "image-of-a-client"],
)
def test_the_override_suggested_gives_the_file_that_was_edited_by_hand(
    demandops: Run,
    state: Any,
    book: Callable[..., Any],
    clone: Path,
    path: str,
    replaced: list[tuple[str, str]],
    gitops: str,
) -> None:
    assert demandops("upgrade", "--state-repo", state.path, "--gitops", gitops).code == 0
    git(clone, "pull", "--quiet")
    text = (clone / path).read_text()
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    (clone / path).write_text(text)
    (suggested,) = demandops("check", clone, "--output", "json").json()["suggestions"]
    git(clone, "checkout", "--quiet", ".")
    (clone / suggested["file"]).parent.mkdir(exist_ok=True)
    (clone / suggested["file"]).write_text(suggested["text"])

    found = demandops("check", clone, "--output", "json").json()
    assert (found["faults"], [one["file"] for one in found["files"]]) == ([], [path])
    git(clone, "add", "--all")
    git(clone, "commit", "--quiet", "-m", "Override instead")
    git(clone, "push", "--quiet", "origin", "main")
    book(id="second")
    assert bodies(state.files()[path]) == bodies(text)


def test_a_markers_edit_is_refused(demandops: Run, clone: Path) -> None:
    marker = clone / "ledger" / "overrides" / "race.yaml"
    marker.parent.mkdir()
    marker.write_text("a: b\n")
    (fault,) = demandops("check", clone, "--output", "json").json()["faults"]
    assert fault["file"] == "ledger/overrides/race.yaml"


def test_a_release_that_is_held_keeps_the_controller_from_being_changed(
    demandops: Run, state: Any, book: Callable[..., Any]
) -> None:
    book()
    before = state.commit(
        {"overrides/race.yaml": override({"services": ["object-fusion"]}, hold=True)}
    )
    ran = demandops("upgrade", "--state-repo", state.path, "--gitops", "argocd")
    assert (ran.code, ran.out, state.tip) == (1, "", before)
    assert ran.err == (
        "error: overrides/race.yaml: hold: keeps the file of "
        "of-edge-object-detection-fusion-cf7e0180a8bb as rendered for the old controller; remove "
        "the hold, and add it again after the upgrade\n"
    )
    state.commit({"overrides/race.yaml": None})
    assert demandops("upgrade", "--state-repo", state.path, "--gitops", "argocd").code == 0


def test_an_upgrade_honours_a_persons_commit_that_no_generator_has_followed(
    demandops: Run, state: Any, book: Callable[..., Any]
) -> None:
    """The commit deletes an application's claims; its override keeps the application running."""
    book()
    keep = override({"applications": ["*"]}, keep=True)
    claims = dict.fromkeys(state.files("ledger/applications/"))
    state.commit({"overrides/race.yaml": keep, **claims})
    ran = demandops("upgrade", "--state-repo", state.path, "--gitops", "argocd")
    assert ran.code == 0, ran.err
    assert FUSION in state.files()
    rows = demandops("verify", "--state-repo", state.path, "--output", "json").json()
    assert [(row["holds"], row["skipped"]) for row in rows] == [(True, None)]
    tip = state.tip
    book()
    assert FUSION in state.files()
    assert len(state.files("ledger/applications/")) >= 1
    assert state.tip != tip
