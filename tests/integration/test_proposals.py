"""Demands that need approval are proposed, listed, awaited and tried in a dry run by commands."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pygit2
import pytest
import yaml

from tests.kit.cli import Ran, Run
from tests.kit.dialogue import Dialogue
from tests.kit.generator import wait_until
from tests.kit.goals import perception, put
from tests.kit.repo import GENERATOR_EMAIL, GENERATOR_NAME, GitRepo, Person, branches, git


@pytest.fixture
def strict(state: GitRepo, person: Person) -> GitRepo:
    """A state repo whose access domain requires approval of demands."""
    person.policy(approval="required")
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
    nothing = demandops("get", "proposals", "--state-repo", strict.path, "--output", "json")
    assert (nothing.code, nothing.json()["items"]) == (0, [])
    ran = send(strict)
    assert (ran.code, ran.err) == (0, "")
    *_, words, branch = ran.out.strip().rpartition("approval ")
    assert words
    assert ran.out == f"standard input: request 0 'request' awaiting approval {branch}\n"
    assert strict.tip == before
    [row] = demandops("get", "proposals", "--state-repo", strict.path, "--output", "json").json()[
        "items"
    ]
    assert row["branch"] == branch
    assert row["requesters"] == ["vehicle00"]
    assert row["summary"] == "Join edge/object_detection_fusion, vehicle00/edge"
    assert row["commit"] == git(strict, "rev-parse", branch)
    assert (row["link"], len(row["operations"])) == (None, 1)
    table = demandops("get", "proposals", "--state-repo", strict.path)
    assert branch in table.out
    assert "vehicle00" in table.out
    mine = demandops("get", "proposals", "--requester", "vehicle00", "--state-repo", strict.path)
    assert (mine.out, mine.err) == (table.out, "")  # although this requester holds nothing yet
    by_url = demandops("get", "proposals", "--state-repo", strict.path.as_uri(), "--output", "json")
    assert by_url.json()["items"] == [row]


def test_a_lease_that_has_not_started_is_explained(
    demandops: Run, send: Send, strict: GitRepo
) -> None:
    send(strict, goal=put("patrol") | {"lease": "1h"})
    git(strict, "branch", "--force", "main", *branches(strict.path))  # no generator runs
    ran = demandops("why", "patrol", "--state-repo", strict.path)
    assert (ran.code, ran.err) == (0, "")
    assert ", lease of 1h, not started\n" in ran.out


def test_the_json_tells_where_it_waits(send: Send, strict: GitRepo) -> None:
    [row] = send(strict, "--output", "json").json()
    branch = "".join(branches(strict.path))
    assert row == {
        "index": 0,
        "request": "request",
        "outcome": "proposed",
        "commit": None,
        "faults": [],
        "warnings": [],
        "not_held": [],
        "placed": [],
        "proposal": {"branch": branch, "link": ""},
    }


@contextmanager
def decided(state: GitRepo, *command: str) -> Iterator[None]:
    """During the block, a person runs a git command on the branch of the first proposal."""

    def decide() -> None:
        wait_until(lambda: branches(state.path), "a demand waits")
        git(state, *command, *branches(state.path))

    person = threading.Thread(target=decide)
    person.start()
    yield
    person.join()


def test_wait_waits_for_the_decision(send: Send, strict: GitRepo) -> None:
    with decided(strict, "branch", "--force", "main"):
        ran = send(strict, "--wait")
    assert ran.code == 0
    assert ran.err.startswith(
        "standard input: request 'request' awaiting approval: demand/request-"
    )
    assert ran.out == f"standard input: request 0 'request' booked in {strict.tip}\n"


def test_one_that_is_turned_down_while_it_waits_is_refused(send: Send, strict: GitRepo) -> None:
    with decided(strict, "branch", "--delete", "--force"):
        ran = send(strict, "--wait")
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
    assert branches(strict.path) == []


def test_a_release_of_what_waits_is_done_by_a_later_call(
    demandops: Run, send: Send, strict: GitRepo
) -> None:
    send(strict)
    ran = send(strict, goal=perception(shutdown=True))
    assert ran.out.startswith("standard input: request 0 'request' released in ")
    assert branches(strict.path) == []


def test_verify_and_log_take_a_merged_proposal(demandops: Run, send: Send, strict: GitRepo) -> None:
    branch = send(strict).out.split()[-1]
    git(strict, "update-ref", "refs/heads/main", f"refs/heads/{branch}")
    ran = demandops("verify", "--state-repo", strict.path)
    assert ran.code == 0
    assert "merged by a person" in ran.out
    [entry] = demandops("log", "-n", "1", "--output", "json", "--state-repo", strict.path).json()
    assert entry["commit"] == strict.tip


def test_a_branch_of_a_time_that_no_calendar_has_is_listed(demandops: Run, state: GitRepo) -> None:
    repo = pygit2.Repository(str(state.path))
    tip = repo[state.tip].peel(pygit2.Commit)
    author = pygit2.Signature("x", "x@example.org", 99_999_999_999_999, 0)
    message = "Odd\n\nProposal: demand/odd\n"
    branch = "refs/heads/demand/odd"
    repo.create_commit(branch, author, tip.committer, message, tip.tree.id, [tip.id])
    listed = demandops("get", "proposals", "--state-repo", state.path, "--output", "json")
    assert [row["branch"] for row in listed.json()["items"]] == ["demand/odd"]


def edit(person: Person, branch: str, content: bytes, *, executable: bool = False) -> str:
    """Push a commit with a file `sketch` to a branch; return the commit's id."""
    person.fetch()
    git(person.folder, "checkout", "--quiet", "-B", "work", f"origin/{branch}")
    person.folder.joinpath("sketch").write_bytes(content)
    git(person.folder, "add", "sketch")
    if executable:
        git(person.folder, "update-index", "--chmod=+x", "sketch")
    git(person.folder, "commit", "--quiet", "--message", "Add a sketch")
    git(person.folder, "push", "--quiet", "origin", f"HEAD:{branch}")
    return git(person.folder, "rev-parse", "HEAD")


def test_what_a_person_added_to_a_proposal_is_approved_with_it(
    demandops: Run, send: Send, strict: GitRepo, person: Person
) -> None:
    send(strict)
    [branch] = branches(strict.path)
    head = edit(person, branch, b"text")
    ran = demandops("approve", branch, "--commit", head, "--state-repo", strict.path)
    assert ran.code == 0 and "  ~ file sketch\n" in ran.err
    assert git(strict, "rev-parse", "main^2") == head
    assert strict.files()["sketch"] == "text"


def test_what_is_more_than_demands_is_listed_and_no_name_of_a_file_adds_lines(
    send: Send, strict: GitRepo, person: Person
) -> None:
    send(strict, goal=put("visit"))
    (branch,) = branches(strict.path)
    person.fetch()
    git(person.folder, "reset", "--quiet", "--hard", f"origin/{branch}")
    generated = next(person.folder.glob("clusters/*/*/edge/of-edge-visit-*.yaml"))
    generated.write_text(generated.read_text().replace("object-fusion", "evil"))
    (person.folder / "ledger/odd.yaml").write_text("a: 1\n")
    (person.folder / "clusters/README.md").write_text("text\n")
    (person.folder / "notes\n  + service harmless").write_text("text\n")
    git(person.folder, "add", "--all")
    by = {"GIT_COMMITTER_NAME": GENERATOR_NAME, "GIT_COMMITTER_EMAIL": GENERATOR_EMAIL}
    message = 'Put\n\nRequester: "a\\n  + nothing"\nProposal: x\nRender-Version: 2\n'
    git(person.folder, "commit", "--quiet", "--message", message, **by)
    git(person.folder, "push", "--quiet", "origin", f"HEAD:{branch}")
    with Dialogue("approve", branch, "--state-repo", strict.path) as asked:
        asked.read_until("Approve it? [y/N]:")
    path = generated.relative_to(person.folder)
    listed = [line.strip() for line in asked.text.splitlines()]
    for file in (path, "ledger/odd.yaml", "clusters/README.md", r"notes\n  + service harmless"):
        assert f"~ file {file}" in listed
    assert not [line for line in listed if line.startswith(("+ service harmless", "+ nothing"))]


def test_a_demand_named_like_the_branch_of_another_is_not_taken_for_it(
    demandops: Run, send: Send, strict: GitRepo
) -> None:
    send(strict, goal=put("visit"))
    [branch] = branches(strict.path)
    head = git(strict, "rev-parse", branch)
    send(strict, goal=put(branch, topic=("/other", "vehicle00")))
    ran = demandops("approve", branch, "--commit", head, "--state-repo", strict.path)
    assert ran.code == 0, ran.err


def test_a_proposal_that_a_person_edited_can_be_rejected(
    demandops: Run, send: Send, strict: GitRepo, person: Person
) -> None:
    send(strict)
    [branch] = branches(strict.path)
    edit(person, branch, b"text")
    assert demandops("reject", branch, "--yes", "--state-repo", strict.path).code == 0
    assert branches(strict.path) == []


@pytest.mark.parametrize("content", [b"\xff\xd8", b"text"], ids=["binary", "executable"])
def test_a_file_that_approve_would_change_is_told(
    demandops: Run, send: Send, strict: GitRepo, person: Person, content: bytes
) -> None:
    send(strict)
    [branch] = branches(strict.path)
    head = edit(person, branch, content, executable=content == b"text")
    tip = strict.tip
    ran = demandops("approve", branch, "--commit", head, "--state-repo", strict.path)
    told = f"sketch in {branch} is not a plain text file; merge the branch with git"
    assert (ran.code, ran.err.splitlines()[-1]) == (1, f"error: {told}")
    assert strict.tip == tip


def _commits(state: GitRepo) -> tuple[str, str]:
    """Return the commits of the only proposal and of main."""
    (branch,) = branches(state.path)
    return git(state, "rev-parse", branch), state.tip


@pytest.mark.parametrize("command", ["approve", "reject"])
def test_a_proposal_that_has_changed_since_it_was_seen_is_left_alone(
    demandops: Run, send: Send, strict: GitRepo, command: str
) -> None:
    send(strict, goal=put("visit"))
    seen, main = _commits(strict)
    send(strict, goal=put("visit", topic=("/other", "vehicle00")))
    now, where = _commits(strict)[0], ("--state-repo", strict.path)
    assert now != seen
    ran = demandops(command, "visit", "--commit", seen, *where)
    assert (ran.code, ran.out) == (1, "")
    assert f"is at commit {now}, not at '{seen}'; if it has changed since" in ran.err
    for other in (now[:39], now.upper(), "HEAD", f"{now[:12]}~0", f"{now}0"):
        assert demandops(command, "visit", "--commit", other, *where).code == 1, other
    assert _commits(strict) == (now, main)
    ran = demandops(command, "visit", "--commit", now, *where)
    assert ran.code == 0, ran.err
    assert (git(strict, "rev-parse", "main^2") == now) if command == "approve" else True
    assert "changed: it replaces demand/visit-" in ran.err and seen in ran.err


@pytest.mark.parametrize("more", [(), ("--yes",), ("--output", "json"), ("--commit", "")])
def test_without_a_terminal_nothing_is_approved_that_was_not_seen(
    demandops: Run, send: Send, strict: GitRepo, more: tuple[str, ...]
) -> None:
    send(strict)
    before = _commits(strict)
    ran = demandops("approve", *branches(strict.path), *more, "--state-repo", strict.path)
    assert (ran.code, ran.out, _commits(strict)) == (2, "", before)
    assert "--commit ID" in ran.err


@pytest.mark.parametrize("typed", ["n", "y"])
def test_at_a_terminal_the_consequence_is_shown_and_just_that_is_merged(
    send: Send, strict: GitRepo, typed: str
) -> None:
    send(strict)
    seen, main = _commits(strict)
    with Dialogue("approve", *branches(strict.path), "--state-repo", strict.path) as asked:
        asked.read_until("Approve it? [y/N]:")
        for told in (seen, "required by access domain 'perception'", "for vehicle00, proposed"):
            assert told in asked.text
        assert "+ connection vehicle00/edge for vehicle00" in asked.text
        assert "+ release od-edge-vehicle00" in asked.text
        asked.type(f"{typed}\n")
        assert asked.end() == (0 if typed == "y" else 1)
    merged = [main, seen] if typed == "y" else []
    assert git(strict, "log", "-1", "--merges", "--format=%P", "main").split() == merged


def test_what_changes_while_a_person_looks_at_it_is_not_merged(send: Send, strict: GitRepo) -> None:
    send(strict, goal=put("visit"))
    (seen, main), (branch,) = _commits(strict), branches(strict.path)
    with Dialogue("approve", branch, "--state-repo", strict.path) as asked:
        asked.read_until("Approve it? [y/N]:")
        send(strict, goal=put("visit", topic=("/other", "vehicle00")))
        asked.type("y\n")
        assert asked.end() == 1
        assert f"{branch} is no longer at commit {seen}, so nothing was merged" in asked.text
    assert strict.tip == main
