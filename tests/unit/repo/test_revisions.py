"""Times and revisions as people write them, and the history of a path as `git log` tells it."""

from __future__ import annotations

import re
from datetime import datetime, timezone
from pathlib import Path
from random import Random

import demandops
import pygit2
import pytest
from demandops.base.errors import StateRepoError
from demandops.repo.git import tree as trees
from demandops.repo.history import commit_log
from pygit2 import Oid
from pygit2.enums import ObjectType

from tests.kit import plain_yaml
from tests.kit.repo import git, write_tree

MAIN = "refs/heads/main"
ROS_BRIDGE = Path(__file__).parents[3] / "ros_bridge"
WHO = pygit2.Signature("a", "a@example.org", 0, 0)
NOW = datetime(2026, 1, 31, 12, 0, 30, tzinfo=timezone.utc)
TABLES = plain_yaml.beside(__file__, "revisions")


@pytest.mark.parametrize(("text", "wanted"), TABLES["times"].items())
def test_a_time_begins_and_ends(text: str, wanted: list[datetime] | None) -> None:
    found = [commit_log.parse_time(text, NOW, end=end) for end in (False, True)]
    times = [one.replace(tzinfo=timezone.utc) for one in wanted or ()]
    assert found == (times or [None, None])


@pytest.fixture
def repo(tmp_path: Path) -> pygit2.Repository:
    """Three commits on main, at 10:00, 10:05 and 10:02, because a clock was set back."""
    repo = pygit2.init_repository(str(tmp_path / "r.git"), bare=True, initial_head="main")
    parents: list[pygit2.Oid] = []
    for minute in (0, 5, 2):
        when = int(datetime(2026, 1, 31, 10, minute, tzinfo=timezone.utc).timestamp())
        who = pygit2.Signature("a", "a@example.org", when, 0)
        tree = repo.TreeBuilder().write()
        made = repo.create_commit("refs/heads/main", who, who, str(minute), tree, parents)
        parents = [made]
    return repo


def commit_of(repo: pygit2.Repository, text: str) -> pygit2.Commit:
    tip = repo.references[MAIN].target
    assert isinstance(tip, pygit2.Oid)
    return commit_log.resolve(repo, tip, text, NOW)


@pytest.mark.parametrize(("text", "told"), TABLES["neither"])
def test_neither_revision_nor_a_time_of_the_state_repo(
    repo: pygit2.Repository, text: str, told: str
) -> None:
    with pytest.raises(StateRepoError) as error:
        commit_of(repo, text)
    assert str(error.value).startswith(told)


@pytest.fixture
def named(repo: pygit2.Repository) -> dict[str, str]:
    """Names and ids in a repository with more than one branch, as name → whole id."""
    tip, middle, first = (str(commit.id) for commit in repo.walk(repo.references[MAIN].target))
    tag = repo.create_tag("annotated", pygit2.Oid(hex=first), ObjectType.COMMIT, WHO, "a tag")
    ids = {"tip": tip, "middle": middle, "first": first, "tag": str(tag)}
    for name, commit in TABLES["references"].items():
        repo.references.create(name.format_map(ids), pygit2.Oid(hex=ids[commit]))
    repo.references.create("refs/tags/folder", repo.TreeBuilder().write())
    return ids


@pytest.mark.parametrize(
    ("text", "wanted"), [(one, name) for name, every in TABLES["commits"].items() for one in every]
)
def test_names_ids_and_steps_back(
    repo: pygit2.Repository, named: dict[str, str], text: str, wanted: str
) -> None:
    assert str(commit_of(repo, text.format_map(named)).id) == named[wanted]


@pytest.mark.parametrize(
    "text",
    [
        *TABLES["none"],
        *("main~" + "9" * 5000, "\udcff", "0" * 40, "f" * 40, "f" * 41, "x" * 251, "x" * 249),
        *("x/" * 120, "x" * 1_000_000, "main" + "^" * 1_000_000),
    ],
)
def test_anything_else_is_refused_and_quoted(
    repo: pygit2.Repository, named: dict[str, str], text: str
) -> None:
    text = text.format_map({**named, "tree": str(repo.TreeBuilder().write())})
    with pytest.raises(StateRepoError) as told:
        commit_of(repo, text)
    assert str(told.value).isprintable()
    assert str(told.value).startswith("'") and len(str(told.value)) < 600


def test_nothing_lets_libgit2_or_git_parse_a_revision() -> None:
    """Their grammars have searches in messages, and some of these end the process."""
    parsers = re.compile(r"rev_?-?parse|resolve_refish|lookup_reference_dwim|rev-list")
    sources = [*Path(demandops.__file__).parent.rglob("*.py"), *ROS_BRIDGE.rglob("*.py")]
    assert len(sources) > 100
    assert [path.name for path in sources if parsers.search(path.read_text())] == []


@pytest.mark.parametrize("text", ["main", "HEAD", ":/2", "{tip:.39}", "none", ""])
def test_a_trailer_or_a_journal_names_a_commit_by_its_whole_id_only(
    repo: pygit2.Repository, named: dict[str, str], text: str
) -> None:
    assert str(trees.commit_of(repo, named["tip"]).id) == named["tip"]
    with pytest.raises(StateRepoError):
        trees.commit_of(repo, text.replace("{tip:.39}", named["tip"][:39]))


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
        return [
            entry.commit for entry, _, _ in commit_log.changes_to(self.repo, self.made[-1], path)
        ]


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
    assert commit_log.removed_files(history.repo, gone, commit_log.RELEASE_FILES) == {
        str(gone): {"r": PATH}
    }
    history.commit("a", 1, path="clusters/c/d/_charts/detection-0.1.0.yaml")
    without_chart = history.commit(None, 2)
    removed = commit_log.removed_files(history.repo, without_chart, commit_log.RELEASE_FILES)
    assert removed == {str(gone): {"r": PATH}}


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
