"""Times as people write them, and the newest commit that main had at a given time."""

from __future__ import annotations

import re
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path

import demandops
import pygit2
import pytest
from demandops.base.errors import StateRepoError
from demandops.repo.git import tree as trees
from demandops.repo.history import revisions
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pygit2.enums import ObjectType

MAIN = "refs/heads/main"
ROS_BRIDGE = Path(__file__).parents[3] / "ros_bridge"
WHO = pygit2.Signature("a", "a@example.org", 0, 0)
NOW = datetime(2026, 1, 31, 12, 0, 30, tzinfo=timezone.utc)


def at(text: str) -> datetime:
    return datetime.fromisoformat(text).replace(tzinfo=timezone.utc)


@pytest.mark.parametrize(
    ("text", "begins", "ends"),
    [
        ("2026-01-30", "2026-01-30T00:00:00", "2026-01-30T23:59:59"),
        ("2026-01-30T14:03", "2026-01-30T14:03:00", "2026-01-30T14:03:59"),
        ("2026-01-30 14:03", "2026-01-30T14:03:00", "2026-01-30T14:03:59"),
        ("2026-01-30T14:03:20", "2026-01-30T14:03:20", "2026-01-30T14:03:20"),
        ("2026-01-30T14:03:20Z", "2026-01-30T14:03:20", "2026-01-30T14:03:20"),
        ("2026-01-30T14:03+02:00", "2026-01-30T12:03:00", "2026-01-30T12:03:59"),
        ("11:59", "2026-01-31T11:59:00", "2026-01-31T11:59:59"),
        ("9:05:07", "2026-01-31T09:05:07", "2026-01-31T09:05:07"),
        ("14:03", "2026-01-30T14:03:00", "2026-01-30T14:03:59"),
        ("2h", "2026-01-31T10:00:30", "2026-01-31T10:00:30"),
        ("1h30m ago", "2026-01-31T10:30:30", "2026-01-31T10:30:30"),
        ("2d", "2026-01-29T12:00:30", "2026-01-29T12:00:30"),
        ("9999-12-31", "9999-12-31T00:00:00", "9999-12-31T23:59:59"),
    ],
)
def test_a_time_begins_and_ends(text: str, begins: str, ends: str) -> None:
    assert revisions.parse_time(text, NOW) == at(begins)
    assert revisions.parse_time(text, NOW, end=True) == at(ends)


@pytest.mark.parametrize(
    "text",
    (
        *("", " ", "now", "main", "2026", "2026-13-01", "25:00", "12:60", "5", "2x", "ago"),
        *("T14:03", "0001-01-01T00:00+05:00", "2026-01-30T14:03:20 UTC"),
    ),
)
def test_a_text_that_is_no_time_gives_none(text: str) -> None:
    assert revisions.parse_time(text, NOW) is None


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
    return revisions.resolve(repo, tip, text, NOW)


def resolved(repo: pygit2.Repository, text: str) -> str:
    return commit_of(repo, text).message


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("main", "2"),
        ("HEAD", "2"),
        ("main~1", "5"),
        ("HEAD^", "5"),
        ("10:00", "0"),
        ("10:01:59", "0"),
        ("10:03", "2"),
        ("11:00", "2"),
        ("1h", "2"),
        ("2026-01-31", "2"),
    ],
)
def test_a_revision_or_the_newest_commit_at_a_time(
    repo: pygit2.Repository, text: str, wanted: str
) -> None:
    assert resolved(repo, text) == wanted


def test_the_name_of_a_tag_comes_before_a_time(repo: pygit2.Repository) -> None:
    repo.references.create("refs/tags/2026-01-31", commit_of(repo, "main~2").id)
    assert resolved(repo, "2026-01-31") == "0"


def test_before_the_first_commit(repo: pygit2.Repository) -> None:
    with pytest.raises(StateRepoError) as told:
        resolved(repo, "9:59:59")
    assert str(told.value) == (
        "at 2026-01-31 09:59:59 UTC the state repo did not exist yet; its first commit is of "
        "2026-01-31 10:00:00 UTC"
    )


@pytest.fixture
def named(repo: pygit2.Repository) -> dict[str, str]:
    """Names and ids in a repository with more than one branch, as name → whole id."""
    tip, middle, first = (str(commit.id) for commit in repo.walk(repo.references[MAIN].target))
    tag = repo.create_tag("annotated", pygit2.Oid(hex=first), ObjectType.COMMIT, WHO, "a tag")
    for name, commit in {
        "refs/tags/plain": middle,
        "refs/heads/demand/a-b": first,
        "refs/heads/\u00e9": middle,
        "refs/remotes/origin/tracked": first,
        "refs/heads/-x": first,
        f"refs/heads/{tip}": first,
        f"refs/heads/{middle[:9]}": first,
        "refs/heads/twice": first,
        "refs/tags/twice": tip,
        "refs/stash": first,
    }.items():
        repo.references.create(name, pygit2.Oid(hex=commit))
    repo.references.create("refs/tags/folder", repo.TreeBuilder().write())
    return {"tip": tip, "middle": middle, "first": first, "tag": str(tag)}


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("main~2", "first"),
        ("main^^", "first"),
        ("main~1~1", "first"),
        ("main~0", "tip"),
        ("HEAD~", "middle"),
        ("refs/heads/main", "tip"),
        ("heads/main", "tip"),
        ("annotated", "first"),
        ("plain~1", "first"),
        ("demand/a-b", "first"),
        ("\u00e9", "middle"),
        ("origin/tracked", "first"),
        ("tracked", "first"),
        ("-x", "first"),
        ("{tag}", "first"),
        ("{first:.8}", "first"),
        ("{middle:.8}~1", "first"),
        ("{tip}", "tip"),  # a branch of that name does not count
        ("refs/heads/{tip}", "first"),
        ("refs/tags/twice", "tip"),
    ],
)
def test_names_ids_and_steps_back(
    repo: pygit2.Repository, named: dict[str, str], text: str, wanted: str
) -> None:
    assert str(commit_of(repo, text.format_map(named)).id) == named[wanted]


@pytest.mark.parametrize(
    "text",
    [
        *(":/2", ":/", ":0:file", "main:file", "main^{{/5}}", "main^{{tree}}", "main^{{}}"),
        *("main^2", "^main", "~1", "@", "@~1", "HEAD@{{1}}", "@{{u}}", "@{{-1}}", "main@{{1h}}"),
        *("main..main", "main...main", "--all", "--upload-pack=x", "-", "refs/heads/../../HEAD"),
        *("../HEAD", "/main", "refs/heads/", "refs/heads/main.lock", "refs/stash", "stash"),
        *("main~3", "main~999999999", "main~9999999999", "main~" + "9" * 5000, "main~-1"),
        *("main\0", "main\n", "main\nx", "\0", "\udcff", "main~\u0661", "\uff12h", "\uff4dain"),
        *("MAIN", "config", "abc", "folder", "{tree}", "{tree:.8}", "{middle:.9}", "twice"),
        *("0" * 40, "f" * 40, "f" * 41, "x" * 251, "x" * 249, "x/" * 120, "x" * 1_000_000),
        *("main" + "^" * 1_000_000, "", " "),
    ],
)  # fmt: skip
def test_anything_else_is_refused_and_quoted(
    repo: pygit2.Repository, named: dict[str, str], text: str
) -> None:
    text = text.format_map({**named, "tree": str(repo.TreeBuilder().write())})
    with pytest.raises(StateRepoError) as told:
        commit_of(repo, text)
    assert str(told.value).isprintable()
    assert str(told.value).startswith("'") and len(str(told.value)) < 600


_PIECES = [
    "main",
    "HEAD",
    "@",
    "{",
    "}",
    "^",
    "~",
    ":/",
    "/",
    "..",
    "-",
    "0",
    "\0",
    "refs/heads/",
    "1h",
]


@given(st.one_of(st.text(), st.lists(st.sampled_from(_PIECES), max_size=12).map("".join)))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_the_text_it_is_a_commit_or_refused(repo: pygit2.Repository, text: str) -> None:
    with suppress(StateRepoError):
        assert isinstance(commit_of(repo, text), pygit2.Commit)


def test_nothing_lets_libgit2_or_git_parse_a_revision() -> None:
    """Their grammars have searches in messages, and some of these end the process."""
    parsers = re.compile(r"rev_?-?parse|resolve_refish|lookup_reference_dwim|rev-list")
    sources = [*Path(demandops.__file__).parent.rglob("*.py"), *ROS_BRIDGE.rglob("*.py")]
    assert len(sources) > 100
    assert [path.name for path in sources if parsers.search(path.read_text())] == []


def test_neither_revision_nor_time(repo: pygit2.Repository) -> None:
    with pytest.raises(StateRepoError) as told:
        resolved(repo, "domain")
    assert str(told.value) == (
        "'domain' is neither a commit of the state repo nor a time; write a branch, a tag or 4 to "
        "40 digits of an id, with ~N for the Nth commit before it, or a time like "
        "2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h (two hours ago); `demandops log` "
        "lists the commits"
    )


@pytest.mark.parametrize("text", ["main", "HEAD", ":/2", "main^{/2}", "{tip:.39}", "none", ""])
def test_a_trailer_or_a_journal_names_a_commit_by_its_whole_id_only(
    repo: pygit2.Repository, named: dict[str, str], text: str
) -> None:
    assert str(trees.commit_of(repo, named["tip"]).id) == named["tip"]
    with pytest.raises(StateRepoError):
        trees.commit_of(repo, text.replace("{tip:.39}", named["tip"][:39]))
