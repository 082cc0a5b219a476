"""A repository answers which of two commits is later, and what differs between them."""

from __future__ import annotations

from pathlib import Path

from demandops.repo.git.remote_repository import connect

from tests.kit import rig
from tests.kit.rig import Person

CHART = "appdefs/object-detection-fusion/charts/object-fusion"
UNKNOWN = "f" * 40


def test_what_changed_between_commits_is_known(bare: Path, person: Person, tmp_path: Path) -> None:
    first = rig.tip(bare)
    other = person.change({"notes.txt": "one\n"})
    chart = person.change({f"{CHART}/notes.txt": "two\n"})
    repo = connect(str(bare), tmp_path / "data")
    assert repo.includes(chart, first) and repo.includes(other, other)
    assert not repo.includes(first, other)
    assert not repo.includes(UNKNOWN, first)
    assert repo.unchanged(first, other, CHART)
    assert not repo.unchanged(first, chart, CHART)
    assert not repo.unchanged(first, other, ".")
    # a folder or commit that does not exist equals nothing
    assert not repo.unchanged(first, other, "no/such/folder")
    assert not repo.unchanged(first, UNKNOWN, CHART)
    assert not repo.unchanged("", first, CHART)
    assert repo.changed_paths(first, chart) == [f"{CHART}/notes.txt", "notes.txt"]
    assert repo.changed_paths(chart, chart) == []
    assert repo.changed_paths("", chart) is repo.changed_paths(UNKNOWN, chart) is None


def test_a_generator_answers_for_the_past_without_another_clone(url: str, data_home: Path) -> None:
    with rig.running(url) as generator:
        first, _ = rig.book(generator, rig.goal(1), rig.goal(2))
        ledger = generator.snapshot_at(first.commit).state.ledger
        assert ledger.claims_with("requester", "user1") and not ledger.claims_with(
            "requester", "user2"
        )
    assert [path.name for path in next(data_home.iterdir()).iterdir()] == ["slot-0"]
