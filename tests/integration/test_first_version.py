"""Commands can read a state repo that DemandOps' first version wrote; an upgrade converts it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.settings import LEDGER_API_VERSION

from tests.integration.conftest import On
from tests.kit.repo import GitRepo, git

EXPERIMENT = Path(__file__).parents[2] / "examples" / "experiment"
BUNDLE = Path(__file__).parents[1] / "fixtures" / "first-version.bundle"
BOOTSTRAP = "bootstrap/c-its.yaml"


@pytest.fixture
def state(tmp_path: Path) -> GitRepo:
    """The first version's: render version 1, ``demandops.ledger/v1``.

    It has the experiment's first three joins, two overrides (one of them has ended), a fourth join,
    a demand with a lease, and a shutdown.
    """
    git(tmp_path, "clone", "--quiet", "--bare", str(BUNDLE), "state.git")
    return GitRepo(tmp_path / "state.git")


def documents(files: dict[str, str]) -> dict[str, Any]:
    """Return each manifest by a name that is the same before and after an upgrade."""
    return {
        f"{path} {place}": document
        for path, text in files.items()
        for place, document in enumerate(filter(None, yaml.safe_load_all(text)))
    }


def without_labels(document: Any) -> Any:
    metadata = {name: item for name, item in document["metadata"].items() if name != "labels"}
    return document | {"metadata": metadata}


def test_an_upgrade_writes_the_same_claims_and_changes_labels_and_the_fusions_outputs_alone(
    on: On, state: GitRepo
) -> None:
    refused = on.refused("request", EXPERIMENT / "6-vehicle01-leaves.yaml")
    assert refused.startswith("error: demandops.yaml: renderVersion: is 1, but ")
    books = on("bookkeeping", "--output", "json").json()
    assert "od-edge-station00" in books["services"]
    assert on("log").code == on("why", "od-edge-station00").code == 0
    old, old_ledger = state.files(), state.ledger()
    # the output topics of a fusion have other names today
    topics = re.compile(r" /(edge|cloud)/(\w+_(?:raw_objects|global_\w+))$", re.M)
    manifests = {path: topics.sub(r" /\1_\2", text) for path, text in state.manifests().items()}
    assert {p for p, text in manifests.items() if text != state.manifests()[p]} == {
        path for path in manifests if path.rpartition("/")[2].startswith("of-")
    }
    before = documents(manifests)
    assert on("upgrade").out.endswith(f"git show main:{BOOTSTRAP} | kubectl apply -f -\n")
    new = state.files()
    assert on("bookkeeping", "--output", "json").json() == books | {"commit": state.tip}
    for path, file in state.ledger().items():
        assert file["apiVersion"] == LEDGER_API_VERSION
        if file["kind"] == "Claim":
            of_both = ("demand", "request", "requesters", "booked")
            assert all(file[name] == old_ledger[path][name] for name in of_both)
            assert ("action" in file) == (file["demand"] != "vehicle03-perception")
    after = documents(state.manifests())
    assert {n: without_labels(one) for n, one in after.items()} == {
        n: without_labels(one) for n, one in before.items()
    }
    for name, document in after.items():
        labels = before[name]["metadata"].get("labels", {})
        assert labels.items() <= document["metadata"].get("labels", {}).items()
    assert {p for p in new if p.startswith("bootstrap/") and new[p] != old[p]} == {BOOTSTRAP}
    assert "nothing to do" in on("upgrade").out
    skipped = [row["skipped"] for row in on("verify", "HEAD", "--output", "json").json()]
    assert skipped == [None]
    assert on("verify").code == 0


def test_demands_of_before_are_given_up_and_restored_after_the_upgrade(
    on: On, state: GitRepo
) -> None:
    before = state.commit({"ledger/shutdowns/0f/0f.yaml": "of a version between\n"})
    assert on("upgrade").code == 0
    assert not state.files("ledger/shutdowns/")
    assert on("request", EXPERIMENT / "6-vehicle01-leaves.yaml").code == 0
    assert not any("vehicle01" in f.get("requesters", ()) for f in state.ledger().values())
    assert on("rollback", before, "--reason", "try", "--drop-newer", "-y").code == 0
    assert any("vehicle01" in f.get("requesters", ()) for f in state.ledger().values())
    assert on("verify").code == 0
    assert git(state, "fsck", "--strict") == ""
