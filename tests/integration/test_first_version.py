"""Commands can read a state repo that DemandOps' first version wrote; an upgrade converts it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.settings import LEDGER_API_VERSION

from tests.kit.cli import Ran, Run
from tests.kit.repo import GitRepo, first_version, git

EXPERIMENT = Path(__file__).parents[2] / "examples" / "experiment"
BOOTSTRAP = "bootstrap/c-its.yaml"


@pytest.fixture
def state(tmp_path: Path) -> GitRepo:
    return first_version(tmp_path / "state.git")


@pytest.fixture
def run(demandops: Run, state: GitRepo) -> Run:
    def call(command: str, *args: str | Path, stdin: str = "") -> Ran:
        return demandops(command, *args, "--state-repo", state.path, stdin=stdin)

    return call


def documents(files: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """Yield each manifest under a name that is the same before and after an upgrade."""
    for path, text in files.items():
        for place, document in enumerate(filter(None, yaml.safe_load_all(text))):
            yield f"{path} {place}", document


def with_todays_topics(text: str) -> str:
    """Return a manifest in which the output topics of a fusion have their present names."""
    return re.sub(r" /(edge|cloud)/(\w+_(?:raw_objects|global_\w+))$", r" /\1_\2", text, flags=re.M)


def without_labels(document: Any) -> Any:
    metadata = {name: item for name, item in document["metadata"].items() if name != "labels"}
    return document | {"metadata": metadata}


def ledger(state: GitRepo) -> dict[str, Any]:
    return {
        path: yaml.safe_load(text)
        for path, text in state.files("ledger/").items()
        if path.endswith(".yaml")
    }


def test_commands_that_read_work_before_the_upgrade_and_others_say_what_to_do(
    run: Run, state: GitRepo
) -> None:
    tip = state.tip
    services = run("bookkeeping", "--output", "json").json()["services"]
    assert "od-edge-station00" in services
    assert run("log").code == run("why", "od-edge-station00").code == 0
    refused = run("request", EXPERIMENT / "6-vehicle01-leaves.yaml")
    assert refused.err == (
        "error: demandops.yaml: renderVersion: is 1, but this generator renders version 2; stop "
        "older generators, then run `demandops upgrade` to render everything again\n"
    )
    assert state.tip == tip


def test_an_upgrade_writes_the_same_claims_and_changes_labels_and_the_fusions_outputs_alone(
    run: Run, state: GitRepo
) -> None:
    books = run("bookkeeping", "--output", "json").json()
    old, old_ledger = state.files(), ledger(state)
    manifests = {path: with_todays_topics(text) for path, text in state.manifests().items()}
    assert {p for p, text in manifests.items() if text != state.manifests()[p]} == {
        path for path in manifests if path.rpartition("/")[2].startswith("of-")
    }
    before = dict(documents(manifests))
    assert run("upgrade").out.endswith(
        "after the upgrade, on the clusters:\n"
        "- c-its: apply the cluster's bootstrap file again, because the file changed\n"
        f"      git show main:{BOOTSTRAP} | kubectl apply -f -\n"
    )
    new = state.files()
    assert run("bookkeeping", "--output", "json").json() == books | {"commit": state.tip}
    for path, file in ledger(state).items():
        joined = file["kind"].endswith("Claim") and file["demand"] != "vehicle03-perception"
        added = {"action": "DeploymentRequest"} if joined else {}
        assert file == old_ledger[path] | {"apiVersion": LEDGER_API_VERSION} | added
    after = dict(documents(state.manifests()))
    assert {n: without_labels(one) for n, one in after.items()} == {
        n: without_labels(one) for n, one in before.items()
    }
    for name, document in after.items():
        labels = before[name]["metadata"].get("labels", {})
        assert labels.items() <= document["metadata"].get("labels", {}).items()
    assert {p for p in new if p.startswith("bootstrap/") and new[p] != old[p]} == {BOOTSTRAP}
    assert "nothing to do" in run("upgrade").out
    skipped = [row["skipped"] for row in run("verify", "HEAD", "--output", "json").json()]
    assert skipped == [None]
    assert run("verify").code == 0


def test_demands_of_before_are_given_up_and_restored_after_the_upgrade(
    run: Run, state: GitRepo
) -> None:
    before = state.tip
    assert run("upgrade").code == 0
    assert run("request", EXPERIMENT / "6-vehicle01-leaves.yaml").code == 0
    assert not any("vehicle01" in file.get("requesters", ()) for file in claims(state))
    assert run("rollback", before, "--reason", "try", "--drop-newer").code == 0
    assert any("vehicle01" in file["requesters"] for file in claims(state))
    assert run("verify").code == 0
    assert git(state, "fsck", "--strict") == ""


def claims(state: GitRepo) -> list[Any]:
    return [file for file in ledger(state).values() if file["kind"].endswith("Claim")]
