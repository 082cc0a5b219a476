"""Approval from the command line: proposed demands, what waits, a dry run."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.kit.cli import Ran, Run
from tests.kit.goals import perception
from tests.kit.repo import GitRepo, git

POLICY = "policy/access-domains.yaml"


@pytest.fixture
def strict(state: GitRepo) -> GitRepo:
    """A state repo whose access domain demands approval."""
    data = yaml.safe_load(state.files(POLICY)[POLICY])
    data["domains"][0]["approval"] = "required"
    state.commit({POLICY: yaml.safe_dump(data)})
    return state


Send = Callable[..., Ran]


@pytest.fixture
def send(demandops: Run) -> Send:
    def call(state: GitRepo, *more: str, goal: Any = None) -> Ran:
        text = yaml.safe_dump(goal or perception())
        return demandops("request", "-", "--state-repo", state.path, *more, stdin=text)

    return call


def test_a_demand_that_needs_approval_is_proposed_and_listed(
    demandops: Run, send: Send, strict: GitRepo
) -> None:
    before = strict.tip
    ran = send(strict)
    assert (ran.code, ran.err) == (0, "")
    *_, words, branch = ran.out.strip().rpartition("approval ")
    assert words
    assert ran.out == f"standard input: request 0 'request' awaiting approval {branch}\n"
    assert strict.tip == before
    [row] = demandops("proposals", "--state-repo", strict.path, "--output", "json").json()
    assert row["branch"] == branch
    assert row["requesters"] == ["vehicle00"]
    assert row["summary"] == "Join edge/object_detection_fusion, vehicle00/edge"
    assert row["commit"] == git(strict, "rev-parse", branch)
    assert (row["link"], len(row["operations"])) == (None, 1)
    table = demandops("proposals", "--state-repo", strict.path)
    assert branch in table.out
    assert "vehicle00" in table.out
    by_url = demandops("proposals", "--state-repo", strict.path.as_uri(), "--output", "json")
    assert by_url.json() == [row]


def test_the_json_tells_where_it_waits(send: Send, strict: GitRepo) -> None:
    [row] = send(strict, "--output", "json").json()
    branch = git(strict, "for-each-ref", "--format=%(refname:short)", "refs/heads/demand")
    assert row == {
        "index": 0,
        "request": "request",
        "outcome": "proposed",
        "commit": None,
        "faults": [],
        "warnings": [],
        "not_held": [],
        "proposal": {"branch": branch, "link": ""},
    }


def test_sent_again_it_waits_on_the_same_branch_and_once_merged_changes_nothing(
    demandops: Run, send: Send, strict: GitRepo
) -> None:
    first, second = send(strict), send(strict)
    assert first.out == second.out
    branch = first.out.split()[-1]
    git(strict, "branch", "--force", "main", branch)
    assert demandops("proposals", "--state-repo", strict.path).out == "nothing awaits approval\n"
    [row] = send(strict, "--output", "json").json()
    assert (row["outcome"], row["commit"]) == ("unchanged", strict.tip)


def test_wait_waits_for_the_decision(send: Send, strict: GitRepo) -> None:
    def merge() -> None:
        for _ in range(1000):
            found = git(strict, "for-each-ref", "--format=%(refname)", "refs/heads/demand")
            if found:
                git(strict, "update-ref", "refs/heads/main", found)
                return
            threading.Event().wait(0.02)

    person = threading.Thread(target=merge)
    person.start()
    ran = send(strict, "--wait")
    person.join()
    assert ran.code == 0
    assert ran.err.startswith(
        "standard input: request 'request' awaiting approval: demand/request-"
    )
    assert ran.out == f"standard input: request 0 'request' booked in {strict.tip}\n"


def test_one_that_is_turned_down_while_it_waits_is_refused(send: Send, strict: GitRepo) -> None:
    def turn_down() -> None:
        for _ in range(1000):
            found = git(strict, "for-each-ref", "--format=%(refname:short)", "refs/heads/demand")
            if found:
                git(strict, "branch", "--delete", "--force", found)
                return
            threading.Event().wait(0.02)

    person = threading.Thread(target=turn_down)
    person.start()
    ran = send(strict, "--wait")
    person.join()
    assert ran.code == 1
    assert "was turned down: demand/request-" in ran.err


def test_a_dry_run_says_that_approval_is_needed(
    demandops: Run, send: Send, strict: GitRepo
) -> None:
    ran = send(strict, "--dry-run")
    assert ran.out.splitlines()[:2] == [
        "Request 0: 'request' would be proposed",
        "  needs approval: access domain 'perception' requires it",
    ]
    [row] = send(strict, "--dry-run", "--output", "json").json()
    assert (row["outcome"], row["approval"]) == ("proposed", ["access domain 'perception'"])
    assert git(strict, "for-each-ref", "refs/heads/demand") == ""


def test_a_release_of_what_waits_is_done_by_a_later_call(
    demandops: Run, send: Send, strict: GitRepo
) -> None:
    send(strict)
    ran = send(strict, goal=perception(shutdown=True))
    assert ran.out.startswith("standard input: request 0 'request' released in ")
    assert git(strict, "for-each-ref", "refs/heads/demand") == ""


def test_verify_and_log_take_a_merged_proposal(demandops: Run, send: Send, strict: GitRepo) -> None:
    branch = send(strict).out.split()[-1]
    git(strict, "update-ref", "refs/heads/main", f"refs/heads/{branch}")
    ran = demandops("verify", "--state-repo", strict.path)
    assert ran.code == 0
    assert "merged by a person" in ran.out
    [entry] = demandops("log", "-n", "1", "--output", "json", "--state-repo", strict.path).json()
    assert entry["commit"] == strict.tip


def test_nothing_waits_in_a_new_state_repo(demandops: Run, state: GitRepo, tmp_path: Path) -> None:
    ran = demandops("proposals", "--state-repo", state.path, "--output", "json")
    assert (ran.code, ran.json()) == (0, [])
