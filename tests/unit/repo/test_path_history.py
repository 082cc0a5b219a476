"""The history of a path equals the output of `git log`, in histories of any shape."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pygit2
import pytest
from demandops.repo.git import tree as trees
from demandops.repo.history import commit_log
from pygit2 import Oid

from tests.kit.repo import git, write_tree

PATH = "clusters/c/d/n/r.yaml"


class History:
    """A repository whose commits are a minute apart; some of them are merges."""

    def __init__(self, folder: Path) -> None:
        self.repo = pygit2.init_repository(str(folder), bare=True, initial_head="main")
        self.made: list[pygit2.Oid] = []

    def commit(self, text: str | None, *parents: int, path: str = PATH) -> pygit2.Oid:
        """Commit a tree with ``text`` at a path, or without a file there if ``text`` is None.

        ``parents`` are the numbers of earlier commits.
        """
        number = len(self.made)
        who = pygit2.Signature("a", "a@example.org", 1_770_000_000 + 60 * number, 0)
        files = {"other": str(number)} | ({path: text} if text is not None else {})
        tree = write_tree(self.repo, None, files)
        above = [self.made[parent] for parent in parents]
        made = self.repo.create_commit(None, who, who, f"{number}\n", tree, above)
        self.made.append(made)
        return made

    def by_git(self, path: str) -> set[str]:
        tip = str(self.made[-1])
        return {*git(self.repo.path, "log", "--format=%H", tip, "--", path).split()}

    def ours(self, path: str) -> list[str]:
        return [t.entry.commit for t in commit_log.changes_to(self.repo, self.made[-1], path)]


@pytest.mark.parametrize("seed", range(6))
def test_the_same_commits_as_git_log(tmp_path: Path, seed: int) -> None:
    random = Random(seed)
    history = History(tmp_path / "r.git")
    history.commit(None)
    for number in range(1, 30):
        parents = {number - 1, random.randrange(number)} if random.random() < 0.3 else {number - 1}
        parents = {random.randrange(number)} if random.random() < 0.1 else parents
        chosen = sorted(parents, reverse=random.random() < 0.5)
        tip = history.repo[history.made[chosen[0]]].peel(pygit2.Commit)
        text = trees.read_text(tip.tree, PATH)
        if random.random() < 0.3:
            text = random.choice([None, "a", "b", "c"])
        history.commit(text, *chosen)
    for path in (PATH, "clusters/c", "nothing"):
        ours = history.ours(path)
        assert set(ours) == history.by_git(path)
        assert len(ours) == len(set(ours))


def test_the_last_time_that_something_stood_there(tmp_path: Path) -> None:
    history = History(tmp_path / "r.git")
    history.commit("a")
    history.commit(None, 0)
    started = history.commit("b", 1)
    first = history.commit("c", 2)
    second = history.commit("d", 3)
    tip = history.commit("d", 4)
    found = commit_log.history_of(history.repo, tip, PATH, 1)
    assert found.started and found.started.commit == str(started)
    assert ([one.commit for one in found.newest], found.more) == ([str(second)], 1)
    assert found.stopped is None
    stopped = history.commit(None, 5)
    gone = commit_log.history_of(history.repo, stopped, PATH, 9)
    assert gone.stopped and gone.stopped.commit == str(stopped)
    assert [one.commit for one in gone.newest] == [str(second), str(first)]
    assert gone.started == found.started
    never = commit_log.history_of(history.repo, stopped, "nothing/there", 9)
    assert never == commit_log.PathHistory(None, (), 0, None)


def test_where_a_release_is_or_once_was(tmp_path: Path) -> None:
    history = History(tmp_path / "r.git")
    there = history.commit("a")
    gone = history.commit(None, 0)
    assert commit_log.release_path(history.repo, there, "r") == PATH
    assert commit_log.release_path(history.repo, gone, "r") == PATH
    assert commit_log.release_path(history.repo, gone, "q") is None
    assert commit_log.release_path(history.repo, gone, "*") is None
    assert commit_log.stopped_release_names(history.repo, gone) == {"r"}
    history.commit("a", 1, path="clusters/c/d/_charts/detection-0.1.0.yaml")
    without_chart = history.commit(None, 2)
    assert commit_log.stopped_release_names(history.repo, without_chart) == {"r"}


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
