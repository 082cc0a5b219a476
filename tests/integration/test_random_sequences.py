"""Long random sequences of requests give the same bookkeeping in a real state repo as in a model.

The model in ``tests/model`` takes the same requests. After each call of `demandops request`, and
at some of the commits that the calls made, both must have the same bookkeeping.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from random import Random
from typing import Any

import pytest
import yaml

from tests.kit.cli import Run
from tests.kit.repo import GitRepo, git
from tests.model.books import Books, Goal, Result, in_model_words, object_lists
from tests.model.goals import SKELETON, Maker

REQUESTS, CALLS = 120, 6
SEEDS = range(1, 1 + int(os.environ.get("DEMANDOPS_EXAMPLES", "1")))


class CommandLine:
    """``demandops`` on one state repo, run in this process."""

    def __init__(self, repo: GitRepo, run: Run) -> None:
        self.repo, self._run = repo, run

    def __call__(self, *arguments: str) -> tuple[int, Any]:
        """Run a command; return its exit code and the JSON that it prints."""
        ran = self._run(*arguments, "--state-repo", self.repo.path, "--output", "json")
        assert ran.out, ran.err
        return ran.code, ran.json()

    def commits(self) -> list[str]:
        return git(self.repo, "rev-list", "--reverse", "main").split()

    def view(self, revision: str) -> dict[str, Any]:
        """Return the bookkeeping at a commit in the form of the model."""
        code, data = self("bookkeeping", "--at", revision)
        assert code == 0
        assert data.pop("commit") == git(self.repo, "rev-parse", revision)
        return in_model_words(data, object_lists(self.repo.files("clusters/", revision).values()))


@pytest.fixture
def command(demandops: Run, state: GitRepo) -> CommandLine:
    return CommandLine(state, demandops)


def written(goals: list[Goal], folder: Path, name: str) -> list[str]:
    """Write goals into two YAML files, one document for each goal; return the files' paths."""
    half = len(goals) // 2
    files = {f"{name}-a.yaml": goals[:half], f"{name}-b.yaml": goals[half:]}
    for file, documents in files.items():
        plain = json.loads(json.dumps(documents))  # copies shared lists: no YAML anchors
        (folder / file).write_text(yaml.safe_dump_all(plain, sort_keys=False))
    return [str(folder / file) for file in files]


def assert_told_as_expected(
    rows: list[dict[str, Any]], expected: list[Result], goals: list[Goal], new: list[str]
) -> None:
    """Check the outcome and the commit of each request in the rows that one call printed."""
    assert [row["outcome"] for row in rows] == [result.outcome for result in expected]
    assert [row["index"] for row in rows] == list(range(len(goals)))
    assert [row["request"] for row in rows] == [goal["id"] for goal in goals]
    done = [row["commit"] for row in rows if row["outcome"] in ("booked", "released")]
    assert done == new, "each demand that changes something must have a commit, in order"
    for row in rows:
        assert bool(row["faults"]) == (row["outcome"] == "refused")
        assert (row["commit"] is None) == (row["outcome"] == "refused")


@pytest.mark.parametrize("seed", SEEDS)
def test_a_state_repo_says_what_the_model_says_after_any_sequence_of_requests(
    seed: int, command: CommandLine, tmp_path: Path
) -> None:
    books = Books(SKELETON)
    goals = Maker(Random(seed)).sequence(REQUESTS)
    views: dict[str, dict[str, Any]] = {}
    first = command.commits()
    before = list(first)
    for call in range(CALLS):
        asked = goals[call * REQUESTS // CALLS : (call + 1) * REQUESTS // CALLS]
        expected, after_each = [], []
        for request in asked:
            expected.append(books.take(request))
            if expected[-1].effective:
                after_each.append(books.view())

        code, rows = command("request", *written(asked, tmp_path, f"call-{call}"))

        after = command.commits()
        new = after[len(before) :]
        assert after[: len(before)] == before, "the history must only grow"
        assert_told_as_expected(rows, expected, asked, new)
        assert code == (1 if any(result.outcome == "refused" for result in expected) else 0)
        assert command.view("main") == books.view()
        views |= dict(zip(new, after_each, strict=True))
        before = after
    effective = len(before) - len(first)
    assert effective == len(views) > REQUESTS // 4

    for commit in Random(seed).sample(sorted(views), 6):
        assert command.view(commit) == views[commit]
    said = git(command.repo, "fsck", "--strict", "--full").splitlines()
    assert [line for line in said if not re.match(r"dangling |notice: ", line)] == []
    code, verdicts = command("verify", f"{first[-1]}..main")
    assert code == 0
    assert [verdict["commit"] for verdict in verdicts] == list(views)
    assert [v for v in verdicts if not v["holds"] or v["skipped"] or v["differing"]] == []


def test_sending_everything_again_makes_no_further_commit(
    command: CommandLine, tmp_path: Path
) -> None:
    maker = Maker(Random(3), calm=True)
    goals = [maker.join() for _ in range(20)]
    command("request", *written(goals, tmp_path, "first"))
    before = command.commits()

    again = [maker.again(request) for request in goals]
    code, rows = command("request", *written(again, tmp_path, "again"))

    assert code == 0
    assert {row["outcome"] for row in rows} == {"unchanged"}
    assert {row["commit"] for row in rows} == {before[-1]}
    assert command.commits() == before
