"""Times as people write them, and the newest commit that main had at a given time."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import pygit2
import pytest
from demandops.errors import StateRepoError
from demandops.staterepo.history import revisions

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


def resolved(repo: pygit2.Repository, text: str) -> str:
    tip = repo.references["refs/heads/main"].target
    assert isinstance(tip, pygit2.Oid)
    return revisions.resolve(repo, tip, text, NOW).message


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
    repo.references.create("refs/tags/2026-01-31", repo.revparse_single("main~2").id)
    assert resolved(repo, "2026-01-31") == "0"


def test_before_the_first_commit(repo: pygit2.Repository) -> None:
    with pytest.raises(StateRepoError) as told:
        resolved(repo, "9:59:59")
    assert str(told.value) == (
        "at 2026-01-31 09:59:59 UTC the state repo did not exist yet; its first commit is of "
        "2026-01-31 10:00:00 UTC"
    )


def test_neither_revision_nor_time(repo: pygit2.Repository) -> None:
    with pytest.raises(StateRepoError) as told:
        resolved(repo, "domain")
    assert str(told.value) == (
        "'domain' is neither a commit of the state repo nor a time; `demandops log` lists the "
        "commits; write a time like 2026-01-31T14:03, 2026-01-31, 14:03 (all UTC) or 2h "
        "(two hours ago)"
    )
