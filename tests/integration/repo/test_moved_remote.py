"""People push between demands: their commits stay, demands go on top, and the history is linear."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from demandops.base.errors import StateRepoError
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.repo import read
from tests.kit.rig import Person, goal, leave

NODES = "inventory/nodes.yaml"
BROKERS = "inventory/brokers.yaml"
OLD_BROKER, NEW_BROKER = "service-mqtt-broker-edge", "broker-of-the-edge"


def _delete_claims(bare: Path, person: Person) -> None:
    person.change(dict.fromkeys(rig.claims(bare, "user1")), "Release what user1 holds")


EITHER = pytest.mark.parametrize(
    ("address", "runs"), [("file-url", True), ("embedded", False)], indirect=["address"]
)
"""While a person changes the repo, the generator runs and uses a remote, or is stopped.

The stopped generator uses the repo in place. Two combinations are enough, because ``address``
and ``runs`` do not affect each other.
"""


def _kinds(bare: Path) -> list[str]:
    """Return the operation of each commit, oldest first; a person's commit is ``person``."""
    return [commit.one("Operation") or "person" for commit in rig.commits(bare)]


@pytest.mark.parametrize("deletes", [True, False], ids=["claims", "inventory"])
def test_a_generator_renders_again_after_a_person_undid_another_generators_work(
    address: str, bare: Path, person: Person, tmp_path: Path, deletes: bool
) -> None:
    """The person undoes a change of claims or brokers, but not what ``second`` rendered for it."""
    with rig.running(address) as first, rig.running(address, data=tmp_path / "other") as second:
        rig.book(first, goal(3))
        rig.book(second, goal(3))
        if not deletes:
            person.edit(BROKERS, OLD_BROKER, NEW_BROKER)
        rig.book(second, goal(1))
        if deletes:
            _delete_claims(bare, person)
        else:
            person.edit(BROKERS, NEW_BROKER, OLD_BROKER)
        rig.book(first, goal(2))
    rig.assert_sound(bare)
    assert rig.books(bare) == rig.books_after(map(goal, (3, 2) if deletes else (3, 1, 2)))


EDITS = {
    "README.md": ("# ", "# Ours, since today: "),
    BROKERS: (OLD_BROKER, NEW_BROKER),
    "demandops.yaml": (
        "gitops: flux\n",
        "gitops: argocd\nargocd:\n  url: https://git.example/state.git\n",
    ),
}


@EITHER
@pytest.mark.parametrize("path", EDITS)
def test_an_edit_is_kept_and_carried_out_before_the_next_demand(
    address: str, bare: Path, person: Person, runs: bool, path: str
) -> None:
    with rig.running(address) as generator:
        rig.book(generator, goal(1))
        if runs:
            made = person.edit(path, *EDITS[path])
            rig.book(generator, goal(2))
    if not runs:
        made = person.edit(path, *EDITS[path])
        with rig.running(address) as generator:
            rig.book(generator, goal(2))
    rig.assert_sound(bare)
    assert EDITS[path][1] in read(bare, path)
    assert rig.books(bare) == rig.books_after([goal(1), goal(2)])
    if path == "README.md":
        assert _kinds(bare) == ["join", "person", "join"]
        return
    assert _kinds(bare) == ["join", "person", "follow", "join"]
    first, _, follow, _ = rig.commits(bare)
    assert dict(follow.trailers) == {
        "Operation": "follow",
        "Follows": made,
        "Since": first.id,
        "Caused-By": f"{made} Petra Platform <petra@example.org>",
        "Render-Version": "2",
    }
    changed = rig.git(bare, "diff-tree", "-r", "--name-only", "--no-commit-id", follow.id)
    assert all(each.startswith(("clusters/", "bootstrap/")) for each in changed.splitlines())
    rendered = rig.git(bare, "grep", "", follow.id, "--", "clusters/*.yaml", "bootstrap/*.yaml")
    if path == BROKERS:
        assert NEW_BROKER in rendered and OLD_BROKER not in rendered
    else:
        assert "kind: Application" in rendered
        assert "fluxcd.io" not in rendered and "_charts" not in rendered


def test_a_claim_whose_file_a_person_broke_can_still_be_released(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, goal(1))
    path = next(path for path in rig.claims(bare, "user1") if "applications" in path)
    person.change({path: "requesters: nobody\n"}, "Tidy up")
    assert rig.book(generator, leave(1))[0].outcome == "released"
    rig.book(generator, goal(2))
    assert rig.claims(bare, "nobody") == []
    assert rig.books(bare) == rig.books_after([goal(2)])
    rig.assert_sound(bare)


@EITHER
def test_an_inventory_change_is_applied_once_a_removed_node_is_released(
    address: str, bare: Path, person: Person, runs: bool
) -> None:
    """One push moves a broker and removes a node in use; later demands release the node."""
    moved = person.read(BROKERS).replace(OLD_BROKER, NEW_BROKER)
    with rig.running(address) as generator:
        rig.book(generator, goal(1), goal(2))
        person.change(rig.without_vehicle01(bare) | {BROKERS: moved}, "vehicle01 is sold")
        rig.book(generator, goal(6), *([leave(1), goal(3)] if runs else []))
    with rig.running(address) as generator:
        rig.book(generator, *([] if runs else [leave(1), goal(3)]))
        assert OLD_BROKER not in rig.git(bare, "grep", "", "main", "--", "clusters")
        assert rig.outcome(generator.submit(goal(1))) == "unknown-node"
    rig.assert_sound(bare)


def test_a_generated_file_that_a_person_edited_is_put_right_with_the_next_commit(
    url: str, bare: Path, person: Person
) -> None:
    """`demandops check` refuses the edit. A person merges the edit nevertheless."""
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        paths = rig.git(bare, "ls-tree", "-r", "--name-only", "main", "clusters/").splitlines()
        edited = next(path for path in paths if "of-edge-fusion-1" in path)
        text = read(bare, edited)
        person.change({edited: text + "# by hand\n"})
        rig.book(generator, goal(2))
    assert read(bare, edited) == text
    assert rig.differing(bare) == {}


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


def test_a_person_who_takes_commits_back_has_the_last_word(address: str, bare: Path) -> None:
    """A person resets main to an older commit, and the next demand goes on top of that commit."""
    with rig.running(address) as generator:
        rig.book(generator, goal(1))
        older = rig.tip(bare)
        rig.book(generator, goal(2))
        rig.git(bare, "update-ref", "refs/heads/main", older)
        rig.book(generator, goal(3))
    assert rig.books(bare) == rig.books_after([goal(1), goal(3)])
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


def test_a_demand_is_judged_against_the_remote_and_not_against_the_clone(
    url: str, bare: Path, person: Person, tmp_path: Path
) -> None:
    joined = goal(2, vehicle=1)
    joined["connections"][0] |= {"source_node_id": "tram07", "id": "tram07/edge"}
    tram = "  - id: tram07\n    type: vehicle\n    cluster: c-its\n"
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        _delete_claims(bare, person)
        assert rig.outcome(generator.submit(goal(1))) == "booked", "it seems booked already"
        person.edit(NODES, "  - id: cloud\n", f"{tram}  - id: cloud\n")
        assert rig.outcome(generator.submit(joined)) == "booked", "its node seems unknown"
        with rig.running(url, data=tmp_path / "another-machine") as other:
            rig.book(other, goal(3))
        assert rig.outcome(generator.submit(leave(3))) == "released", "it seems not to be held"


def test_no_demand_is_answered_from_a_stale_clone_while_the_remote_is_away(
    url: str, bare: Path, person: Person, caplog: pytest.LogCaptureFixture
) -> None:
    """Decided from the clone, ``again`` would change nothing, and ``late`` would be refused."""
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        _delete_claims(bare, person)
        with rig.away(bare):
            again = generator.submit(goal(1))
            late = generator.submit(rig.impossible())
            rig.wait_until(lambda: "trying again" in caplog.text, "the remote was asked in vain")
            assert not again.future.done()
            assert not late.future.done()
        assert (rig.outcome(again), rig.outcome(late)) == ("booked", "unknown-node")
    assert rig.books(bare) == rig.books_after([goal(1)])


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
