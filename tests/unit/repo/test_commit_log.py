"""The commits that are reachable from one commit and not from another."""

from __future__ import annotations

from pathlib import Path

import pygit2
from demandops.repo.history import commit_log
from pygit2 import Oid


def test_a_clock_that_was_set_back_hides_no_commit_and_shows_no_known_one(tmp_path: Path) -> None:
    repo = pygit2.init_repository(str(tmp_path), bare=True)
    tree = repo.TreeBuilder().write()

    def commit(seconds: int, *parents: Oid) -> Oid:
        who = pygit2.Signature("someone", "someone@example.org", seconds)
        return repo.create_commit(None, who, who, f"at {seconds}", tree, list(parents))

    first = until = commit(1000)
    # after second 1030 the clock is set back to 10
    for second in (*range(1001, 1031), *range(10, 40)):
        until = commit(second, until)
    branch = commit(5000, first)
    merge = commit(5001, until, branch)
    found = {one.id for one, _ in commit_log.commits(repo, str(merge), str(until))}
    assert found == {merge, branch}
