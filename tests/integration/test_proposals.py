"""Demands that need approval are awaited, approved and rejected; see ``stories/proposals.yaml``."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pygit2
import pytest

from tests.integration.conftest import On
from tests.kit.cli import Dialogue
from tests.kit.goals import perception, put
from tests.kit.repo import GENERATOR_EMAIL, GENERATOR_NAME, GitRepo, Person, branches, git
from tests.kit.rig import wait_until

VISIT, OTHER = put("visit"), put("visit", topic=("/other", "vehicle00"))

pytestmark = pytest.mark.usefixtures("strict", "git_environment")


@pytest.fixture
def strict(state: GitRepo, person: Person) -> GitRepo:
    """A state repo whose access domain requires approval of demands."""
    person.policy(approval="required")
    return state


@pytest.fixture
def branch(on: On, strict: GitRepo) -> str:
    """The branch of a demand that waits for approval."""
    on.book(VISIT)
    (branch,) = branches(strict.path)
    return branch


def at(state: GitRepo, branch: str) -> str:
    return git(state, "rev-parse", branch)


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


def test_wait_waits_for_the_decision(on: On, strict: GitRepo) -> None:
    with decided(strict, "branch", "--delete", "--force"):
        ran = on.request(perception(), more=("--wait",))
    [row] = ran.json()
    assert (ran.code, row["outcome"]) == (1, "refused")
    assert "was turned down: demand/request-" in row["faults"][0]["message"]
    with decided(strict, "branch", "--force", "main"):
        ran = on.book(perception(), more=("--wait",))
    assert "awaiting approval: demand/request-" in ran.err
    assert ran.out == f"standard input: request 0 'request' booked in {strict.tip}\n"


def test_a_branch_of_a_time_that_no_calendar_has_is_listed(on: On, state: GitRepo) -> None:
    repo = pygit2.Repository(str(state.path))
    tip = repo[state.tip].peel(pygit2.Commit)
    author = pygit2.Signature("x", "x@example.org", 99_999_999_999_999, 0)
    message = "Odd\n\nProposal: demand/odd\n"
    branch = "refs/heads/demand/odd"
    repo.create_commit(branch, author, tip.committer, message, tip.tree.id, [tip.id])
    assert [row["branch"] for row in on.json("get", "proposals")["items"]] == ["demand/odd"]


def test_what_is_more_than_demands_is_listed_and_no_name_of_a_file_adds_lines(
    strict: GitRepo, person: Person, branch: str
) -> None:
    person.fetch()
    git(person.folder, "reset", "--quiet", "--hard", f"origin/{branch}")
    generated = next(person.folder.glob("clusters/*/*/edge/of-edge-visit-*.yaml"))
    generated.write_text(generated.read_text().replace("object-fusion", "evil"))
    (person.folder / "ledger/odd.yaml").write_text("a: 1\n")
    (person.folder / "clusters/README.md").write_text("text\n")
    (person.folder / "notes\n  + service harmless").write_text("text\n")
    git(person.folder, "add", "--all")
    by = {"GIT_COMMITTER_NAME": GENERATOR_NAME, "GIT_COMMITTER_EMAIL": GENERATOR_EMAIL}
    message = 'Put\n\nRequester: "a\\n  + nothing"\nProposal: x\nRender-Version: 3\n'
    git(person.folder, "commit", "--quiet", "--message", message, **by)
    git(person.folder, "push", "--quiet", "origin", f"HEAD:{branch}")
    with Dialogue("approve", branch, "--state-repo", strict.path) as asked:
        asked.read_until("Approve it? [y/N]:")
    path = generated.relative_to(person.folder)
    listed = [line.strip() for line in asked.text.splitlines()]
    for file in (path, "ledger/odd.yaml", "clusters/README.md", r"notes\n  + service harmless"):
        assert f"~ file {file}" in listed
    assert not [line for line in listed if line.startswith(("+ service harmless", "+ nothing"))]


def test_at_a_terminal_the_consequence_is_shown_and_just_that_is_merged(
    on: On, strict: GitRepo, branch: str
) -> None:
    seen, main = at(strict, branch), strict.tip
    with Dialogue("approve", branch, "--state-repo", strict.path) as asked:
        asked.read_until("Approve it? [y/N]:")
        for told in (seen, "required by access domain 'perception'", "for vehicle00, proposed"):
            assert told in asked.text
        assert "+ release of-edge-visit-" in asked.text
        on.book(OTHER)  # what changes while a person looks at it is not merged
        asked.type("y\n")
        assert asked.end() == 1
        told = " ".join(asked.text.split())  # the terminal has wrapped it
        assert f"{branch} is no longer at commit {seen}, so nothing was changed" in told
    assert strict.tip == main
    (branch,) = branches(strict.path)
    seen = at(strict, branch)
    with Dialogue("approve", branch, "--state-repo", strict.path) as asked:
        asked.read_until("Approve it? [y/N]:")
        asked.type("y\n")
        assert asked.end() == 0
    assert git(strict, "log", "-1", "--merges", "--format=%P", "main").split() == [main, seen]


def test_at_a_terminal_a_rejection_asks_why(strict: GitRepo, branch: str) -> None:
    with Dialogue("reject", branch, "--state-repo", strict.path) as asked:
        for question, answer in (("Why: ", "Out of hours"), ("Reject it? [y/N]:", "y")):
            asked.read_until(question)
            asked.type(f"{answer}\n")
        assert asked.end() == 0, asked.text
    reason = git(strict, "log", "-1", "--format=%(trailers:key=Reason,valueonly)", "main")
    assert reason.strip() == "Out of hours"
