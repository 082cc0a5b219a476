"""What people see of a change: of releases and files, of the bookkeeping, and of an override."""

from __future__ import annotations

from typing import Any

import pytest
from demandops.decide.bookkeeping import bookkeeping, bookkeeping_changes
from demandops.decide.override_report import affected_releases, override_report, override_state
from demandops.decide.state import (
    ABSENT,
    MergePreview,
    leaf_differences,
    planned_releases,
    preview,
)
from demandops.model.config.load import load
from demandops.model.demand.goals import read_journaled, rollback
from demandops.render.gitops import path_of

from tests.kit import plain_yaml
from tests.kit.config import configuration, override, state_of
from tests.kit.goals import APP, application, goal, perception, put
from tests.kit.memory import NOW, MemoryRepo

CASES = plain_yaml.beside(__file__)


@pytest.mark.parametrize(("old", "new", "leaves"), CASES["leaves"])
def test_the_smallest_parts_differ(old: Any, new: Any, leaves: list[Any]) -> None:
    told = [[path, *sides] for path, *sides in leaf_differences(old, new)]
    assert repr(told).replace(repr(ABSENT), "'ABSENT'") == repr(leaves)


def merged(books: MemoryRepo, text: str) -> MemoryRepo:
    """Return the repo after the merge of the override ``later``, all files rendered anew."""
    config = load(configuration({"overrides/later.yaml": text}))
    return MemoryRepo(state=state_of(config, books.state.ledger))


def merge_preview(before: MemoryRepo, after: MemoryRepo) -> MergePreview:
    old, new = (planned_releases(repo.state) for repo in (before, after))
    return preview(old, new, before.below("clusters"), after.below("clusters"))


@pytest.mark.parametrize(("effects", "change"), CASES["merges"])
def test_a_merge_tells_each_release_that_changes(
    effects: dict[str, Any], change: list[str]
) -> None:
    books = MemoryRepo()
    books.send(perception())
    told = merge_preview(books, merged(books, override({"applications": [APP]}, **effects)))
    assert [[each.change, *each.details] for each in told.releases] == [change] * 2
    assert told.other_files == ()
    for file in told.files:
        assert file.change == ("changed" if file.before and file.after else "removed")
        assert ("+++ /dev/null" in file.diff()) == (file.change == "removed")


def test_the_bookkeeping_tells_facts_that_hold_no_longer_and_new_ones() -> None:
    books = MemoryRepo()
    books.send(perception())
    old = bookkeeping(books.state)
    books.send(goal([application(who=["crew"], ego=[("/ego", "vehicle00")])], id="crew"))
    books.send(goal([], perception()["connections"], id="request", shutdown=True))
    books.send(put("other", id="edge/other", lease=60))
    told = [
        [one.kind, one.name, one.change, [*one.lost], [*one.gained]]
        for one in bookkeeping_changes(old, bookkeeping(books.state))
    ]
    assert told == CASES["booked"]


def test_an_override_affects_what_it_stops() -> None:
    books = MemoryRepo()
    books.send(perception())
    after = merged(books, override({"applications": [APP]}, deny=True))
    (entry,) = override_report(after.state, NOW)
    stopped = {path_of(release) for release in affected_releases(entry, after.state)}
    assert stopped == {path for path in books.rendered() if path.rpartition("/")[2].startswith("o")}
    assert override_state(entry, after.state, []) == "in force"
    assert override_state(entry, after.state, stopped) == "not rendered yet"


def test_what_a_person_ordered_is_read_back_from_the_journal() -> None:
    ordered = rollback("abc", drop_newer=True, reason="a  test", who=("Petra", "p@x"), demand="d")
    assert read_journaled(ordered.goal) == ordered
    assert (ordered.to, ordered.drop_newer, ordered.demand, ordered.application) == (
        "abc",
        True,
        "d",
        "",
    )
    assert (ordered.reason, ordered.by, ordered.email) == ("a test", "Petra", "p@x")
