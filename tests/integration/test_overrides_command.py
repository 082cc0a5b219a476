"""What commands say of overrides and do with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.integration.conftest import On
from tests.kit.cli import Run
from tests.kit.config import override
from tests.kit.goals import perception
from tests.kit.repo import GitRepo, git

FUSION = "clusters/c-its/perception/edge/of-edge-object-detection-fusion-cf7e0180a8bb.yaml"
CLIENT = "clusters/c-its/perception/vehicle00/mqtt-vehicle00-edge-source-d3ca91c2df6c.yaml"


@pytest.fixture
def clone(on: On, state: GitRepo, tmp_path: Path) -> Path:
    on.book(perception())
    git(tmp_path, "clone", "--quiet", str(state.path), "clone")
    return tmp_path / "clone"


VALUES = [("domainId: 0", "domainId: 7"), ("replicas: 1", "replicas: 3")]


@pytest.mark.parametrize(
    ("path", "replaced", "gitops"),
    [
        (FUSION, VALUES, "flux"),
        (FUSION, VALUES, "argocd"),
        (CLIENT, [("mqtt-client:2025-04", "mqtt-client:2026-01")], "flux"),
    ],
    ids=["values-and-replicas", "with-argocd", "image-of-a-client"],
)
def test_the_override_suggested_gives_the_file_that_was_edited_by_hand(
    on: On, demandops: Run, clone: Path, path: str, replaced: list[tuple[str, str]], gitops: str
) -> None:
    def check() -> Any:
        return json.loads(demandops("check", clone, "--output", "json").out)

    assert on("upgrade", "--gitops", gitops).code == 0
    git(clone, "pull", "--quiet")
    text = (clone / path).read_text()
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    (clone / path).write_text(text)
    (suggested,) = check()["suggestions"]
    git(clone, "checkout", "--quiet", ".")
    (clone / suggested["file"]).parent.mkdir(exist_ok=True)
    (clone / suggested["file"]).write_text(suggested["text"])
    found = check()
    assert (found["faults"], [one["file"] for one in found["files"]]) == ([], [path])
    git(clone, "add", "--all")
    git(clone, "commit", "--quiet", "-m", "Override instead")
    git(clone, "push", "--quiet", "origin", "main")
    on.book(perception(id="second"))
    written = on.state.files()[path]
    assert [*yaml.safe_load_all(written)] == [*yaml.safe_load_all(text)]


class TestUpgrade:
    def test_it_honours_a_persons_commit_that_no_generator_has_followed(
        self, on: On, state: GitRepo
    ) -> None:
        """The commit deletes an application's claims; its override keeps the application."""
        on.book(perception())
        keep = override({"applications": ["*"]}, keep=True)
        claims = dict.fromkeys(state.files("ledger/applications/"))
        state.commit({"overrides/race.yaml": keep, **claims})
        assert on("upgrade", "--gitops", "argocd").code == 0
        assert FUSION in state.files()
        rows = on.json("verify")
        assert [(row["holds"], row["skipped"]) for row in rows] == [(True, None)]
        tip = state.tip
        on.book(perception())
        assert FUSION in state.files()
        assert state.files("ledger/applications/")
        assert state.tip != tip
