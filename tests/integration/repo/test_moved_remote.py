"""People push between demands: their commits stay, demands go on top, and the history is linear."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from demandops.base.errors import StateRepoError

from tests.kit import rig
from tests.kit.rig import Person, goal

BROKERS = "inventory/brokers.yaml"
OLD_BROKER, NEW_BROKER = "service-mqtt-broker-edge", "broker-of-the-edge"


def _kinds(bare: Path) -> list[str]:
    """Return the operation of each commit, oldest first; a person's commit is ``person``."""
    return [commit.one("Operation") or "person" for commit in rig.commits(bare)]


# ---- never a text merge, never a force push ----


def test_the_remote_is_never_force_pushed_and_nothing_is_merged(
    url: str, bare: Path, person: Person
) -> None:
    rig.git(bare, "config", "receive.denyNonFastForwards", "true")
    rig.git(bare, "config", "core.logAllRefUpdates", "always")
    with rig.running(url) as generator:
        for number in range(4):
            if number:
                person.change({"README.md": f"{number}\n"})
            rig.book(generator, goal(number))
    moves = rig.git(bare, "log", "--walk-reflogs", "--format=%H", "main").splitlines()[::-1]
    for older, newer in pairwise(moves):
        rig.git(bare, "merge-base", "--is-ancestor", older, newer)
    assert _kinds(bare) == ["join", *["person", "join"] * 3]
    rig.assert_sound(bare)


def test_a_merge_commit_of_a_person_is_followed_like_any_other(
    url: str, bare: Path, person: Person
) -> None:
    rig.git(bare, "branch", "move-broker")
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        person.fetch()
        rig.git(person.folder, "checkout", "--quiet", "-B", "work", "origin/move-broker")
        brokers = person.folder / BROKERS
        brokers.write_text(brokers.read_text().replace(OLD_BROKER, NEW_BROKER))
        rig.git(person.folder, "commit", "--quiet", "--all", "--message", "Move the broker")
        rig.git(person.folder, "push", "--quiet", "origin", "HEAD:move-broker")
        person.merge("move-broker", "--no-ff", "--message", "Merge")
        rig.book(generator, goal(2))
    first_parents = rig.git(bare, "log", "--reverse", "--first-parent", "--format=%s", "main")
    merged, followed = first_parents.splitlines()[2:4]
    assert merged == "Merge" and followed.startswith("Update ")
    assert NEW_BROKER in rig.git(bare, "grep", "", "main", "--", "clusters")
    assert rig.differing(bare) == {}


# ---- a clone that is behind ----


@pytest.mark.parametrize("kind", ["heads", "tags"])
def test_a_reference_whose_name_ends_like_main_stops_no_demand(
    url: str, bare: Path, kind: str
) -> None:
    """A person who pushes to `refs/heads/refs/heads/main` needs no right to push to main."""
    rig.git(bare, "update-ref", f"refs/{kind}/refs/heads/main", "main")
    with rig.running(url) as generator:
        rig.book(generator, goal(1), goal(2))
        clone = generator._slot.folder / "clone.git"
    assert rig.git(clone, "for-each-ref", "--format=%(refname)") == "refs/remotes/origin/main"
    rig.git(bare, "update-ref", "-d", f"refs/{kind}/refs/heads/main")
    rig.assert_sound(bare)


def test_a_main_that_is_gone_is_told_and_followed_when_it_is_restored(
    address: str, bare: Path
) -> None:
    with rig.running(address) as generator:
        rig.book(generator, goal(1))
        rig.git(bare, "branch", "--move", "main", "trunk")
        with pytest.raises(StateRepoError, match="has no branch 'main'"):
            rig.book(generator, goal(2))
        rig.git(bare, "branch", "--move", "trunk", "main")
        rig.book(generator, goal(2))
    rig.assert_sound(bare)
