"""A state repo of the second version, with faults on main, a proposal and a journal, is carried on.

``tests/fixtures/second-version/README.md`` says what it holds.
"""

from __future__ import annotations

import shutil
from collections import Counter
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from demandops.base import settings
from demandops.serve.journal import read

from tests.integration.conftest import On
from tests.kit import plain_yaml
from tests.kit.cli import Run
from tests.kit.clock import Clock
from tests.kit.repo import GitRepo, Person, branches, git, operations, root
from tests.kit.rig import running, wait_until

FIXTURE = Path(__file__).parents[1] / "fixtures" / "second-version"
FACTS: dict[str, Any] = plain_yaml.load((FIXTURE / "facts.yaml").read_text())

pytestmark = pytest.mark.usefixtures("git_environment")


@pytest.fixture
def state(tmp_path: Path) -> GitRepo:
    path = tmp_path / "state.git"
    git(tmp_path, "clone", "--quiet", "--bare", str(FIXTURE / "state.bundle"), str(path))
    return GitRepo(path)


@pytest.fixture
def person(state: GitRepo, tmp_path: Path) -> Person:
    return Person(state.path, tmp_path / "person")


@pytest.fixture
def journal(state: GitRepo, data_home: Path) -> Path:
    """The journal of the killed generator, where the next one for the state repo finds it."""
    path = settings.data_home(str(state.path)) / "slot-0" / "outbox.jsonl"
    path.parent.mkdir(parents=True)
    shutil.copy(FIXTURE / "outbox.jsonl", path)
    return path


@pytest.fixture
def clock() -> Clock:
    """A clock that begins when the generator was killed: no lease has ended yet."""
    clock = Clock()
    clock.set_by((datetime.fromisoformat(FACTS["made"]) - clock.now()).total_seconds())
    return clock


def assert_verified(on: On, since: str) -> None:
    assert all(row["holds"] for row in on("verify", f"{since}..", "-o", "json").json())
    assert git(on.state, "fsck", "--strict", "--no-dangling", "--no-progress") == ""


def mend(state: GitRepo, person: Person) -> None:
    before = state.files(revision="before-faults")
    broken = [*FACTS["faults"], FACTS["heldBack"]]
    person.change({path: before[path] for path in broken}, "Mend the inventory and the claim")


def test_its_history_verifies_and_check_and_upgrade_name_the_faults_on_main(
    demandops: Run, on: On, state: GitRepo, tmp_path: Path
) -> None:
    assert (state.tip, branches(state.path)) == (FACTS["main"], [FACTS["proposal"]["branch"]])
    assert_verified(on, root(state.path))
    assert Counter(file["kind"] for file in state.ledger().values()) == FACTS["kinds"]
    services = on("bookkeeping", "--output", "json").json()["services"]
    names = {path.rpartition("/")[2].removesuffix(".yaml") for path in state.manifests()}
    assert services.keys() <= {*FACTS["releases"]} <= names
    git(tmp_path, "clone", "--quiet", str(state.path), "clone")
    faults = demandops("check", tmp_path / "clone", "--output", "json").json()["faults"]
    told = on.refused("upgrade")
    for file, fields in FACTS["faults"].items():
        assert {fault["field"] for fault in faults if fault["file"] == file} == {*fields}
        assert all(f"error: {file}: {field}: " in told for field in fields)


def test_a_generator_publishes_the_journal_once_and_keeps_the_proposal_open(
    on: On, state: GitRepo, person: Person, journal: Path, clock: Clock
) -> None:
    proposal, pending = FACTS["proposal"], sorted(FACTS["pending"].values())
    assert read(journal).keys() == {proposal["operation"], *pending}
    mend(state, person)
    assert on("upgrade").code == 0
    for _ in range(2):
        with running(state.path, runtime=clock):
            wait_until(lambda: read(journal).keys() == {proposal["operation"]}, "all is published")
    published = [id for id in operations(state.path) if id in pending]
    assert sorted(published) == pending
    (shown,) = on("get", "proposals", "--output", "json").json()["items"]
    assert shown["branch"] == proposal["branch"]
    held = {file["demand"] for file in state.ledger().values() if file["kind"] == "Claim"}
    assert held & {"visit", "pending-put", "closed"} == {"pending-put"}
    assert_verified(on, FACTS["main"])


DOUBLED = {"vehicle01/edge"}
CLIENTS_OF_DOUBLED = {
    "mqtt-vehicle01-edge-source-092a70a6cc97.yaml",
    "mqtt-vehicle01-edge-target-f918b3fb6980.yaml",
}


def test_an_upgrade_takes_every_claim_and_waiting_demand_along(
    demandops: Run, on: On, state: GitRepo, person: Person, clock: Clock, tmp_path: Path
) -> None:
    mend(state, person)
    before = on("bookkeeping", "--output", "json").json()
    manifests = state.manifests()
    assert on("upgrade").code == 0
    after = on("bookkeeping", "--output", "json").json()
    # a connection whose only topic an older one carries is gone
    carried, carried_before = after.pop("connections"), before.pop("connections")
    assert after | {"commit": ""} == before | {"commit": ""}
    gone = carried_before.keys() - carried.keys()
    assert (gone, carried.keys() - carried_before.keys()) == (DOUBLED, set())
    listed = (each.get("listed", {}).values() for each in carried.values())
    assert {id for topics in listed for ids in topics for id in ids} == DOUBLED
    kinds = Counter((file["kind"], file["apiVersion"]) for file in state.ledger().values())
    assert {version for _, version in kinds} == {"demandops.ledger/v3"}
    assert {kind for kind, _ in kinds} == {"Claim", "WaitingDemand", "EndedOverride"}
    ended = {*manifests} - {*state.manifests()}
    assert {*state.manifests()} < {*manifests}
    assert {path.rpartition("/")[2] for path in ended} == CLIENTS_OF_DOUBLED
    git(tmp_path, "clone", "--quiet", str(state.path), "clone")
    assert demandops("check", tmp_path / "clone").code == 0
    with running(state.path, runtime=clock, fetch_interval=0.05):
        wait_until(lambda: not state.files(".demandops/reports/"), "the report is gone")
    assert "nothing to do" in on("upgrade").out
    assert_verified(on, FACTS["main"])
