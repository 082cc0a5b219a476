"""A repository answers which of two commits is later, and what differs between them.

The program needs both answers to read the state of clusters. The tests use real Git repositories.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from demandops.repo import reader
from demandops.repo.git.local_repository import connect

from tests.kit import rig
from tests.kit.rig import Person

CHART = "appdefs/object-detection-fusion/charts/object-fusion"


@pytest.fixture
def line(bare: Path, tmp_path: Path) -> list[str]:
    """Three commits: the repo's first one, a change of a text file, and a change of a chart."""
    person = Person(bare, tmp_path / "person")
    first = rig.tip(bare)
    other = person.change({"notes.txt": "one\n"})
    return [first, other, person.change({f"{CHART}/notes.txt": "two\n"})]


def test_a_commit_includes_those_before_it(bare: Path, line: list[str]) -> None:
    with reader.opened(str(bare)) as opened:
        repo = opened.repository
        assert repo.includes(line[2], line[0]) and repo.includes(line[1], line[1])
        assert not repo.includes(line[0], line[1])
        assert not repo.includes("f" * 40, line[0])


def test_a_folder_is_unchanged_where_its_content_is(bare: Path, line: list[str]) -> None:
    first, other, chart = line
    with reader.opened(str(bare)) as opened:
        repo = opened.repository
        assert repo.unchanged(first, other, CHART)
        assert not repo.unchanged(first, chart, CHART)
        assert not repo.unchanged(first, other, ".")
        # a folder or commit that does not exist equals nothing
        assert not repo.unchanged(first, other, "no/such/folder")
        assert not repo.unchanged(first, "f" * 40, CHART)
        assert not repo.unchanged("", first, CHART)


def test_the_paths_that_differ_are_told(bare: Path, tmp_path: Path, line: list[str]) -> None:
    repository = connect(str(bare), tmp_path / "data")
    assert repository.changed_paths(line[0], line[2]) == [f"{CHART}/notes.txt", "notes.txt"]
    assert repository.changed_paths(line[2], line[2]) == []
    assert repository.changed_paths("", line[2]) is None
    assert repository.changed_paths("f" * 40, line[2]) is None


def test_a_generator_answers_for_the_past_without_another_clone(url: str, data_home: Path) -> None:
    with rig.running(url) as generator:
        first, _ = rig.book(generator, rig.goal(1), rig.goal(2))
        ledger = generator.snapshot_at(first.commit).state.ledger
        assert ledger.claims_of_requester("user1") and not ledger.claims_of_requester("user2")
    assert [path.name for path in next(data_home.iterdir()).iterdir()] == ["slot-0"]
