"""People push between demands: their commits stay, demands go on top, and the history is linear."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from demandops.base.errors import InvalidInput, Refused, StateRepoError

from tests.kit import rig
from tests.kit.rig import Person, goal, leave

NODES = "inventory/nodes.yaml"
BROKERS = "inventory/brokers.yaml"


def _edit_readme(person: Person) -> str:
    return person.change({"README.md": "Ours, since today.\n"}, "Say whose it is")


def _move_broker(person: Person) -> str:
    return person.edit(BROKERS, "service-mqtt-broker-edge", "broker-of-the-edge")


def _choose_argocd(person: Person) -> str:
    url = "https://git.example/state.git"
    return person.edit(
        "demandops.yaml", "gitops: flux\n", f"gitops: argocd\nargocd:\n  url: {url}\n"
    )


def _add_node(person: Person) -> str:
    return person.edit(NODES, "  - id: cloud\n", "  - id: tram07\n    type: vehicle\n"
                       "    cluster: c-its\n  - id: cloud\n")  # fmt: skip


def _take_vehicle01_away(bare: Path, person: Person) -> str:
    return person.change(rig.without_vehicle01(bare), "vehicle01 is sold")


def _delete_claims(bare: Path) -> Callable[[Person], str]:
    return lambda person: person.change(
        dict.fromkeys(rig.claims(bare, "user1")), "Release what user1 holds"
    )


def _break_claim(bare: Path) -> Callable[[Person], str]:
    path = next(path for path in rig.claims(bare, "user1") if "applications" in path)
    return lambda person: person.change({path: "requesters: nobody\n"}, "Tidy up")


EITHER = pytest.mark.parametrize(
    ("address", "running"), [("file-url", True), ("embedded", False)], indirect=["address"]
)
"""While a person changes the repo, the generator runs and uses a remote, or is stopped.

The stopped generator uses the repo in place. Two combinations are enough, because ``address``
and ``running`` do not affect each other.
"""


def _around(
    address: str,
    running: bool,
    before: list[rig.Goal],
    change: Callable[[], str],
    after: list[rig.Goal],
) -> str:
    """Book demands before and after a person's change; return the person's commit.

    If ``running``, the generator runs during the change. Otherwise the generator stops before the
    change, and starts again after the change.
    """
    if running:
        with rig.running(address) as generator:
            rig.book(generator, *before)
            made = change()
            rig.book(generator, *after)
        return made
    with rig.running(address) as generator:
        rig.book(generator, *before)
    made = change()
    with rig.running(address) as generator:
        rig.book(generator, *after)
    return made


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
            _move_broker(person)
        rig.book(second, goal(1))
        if deletes:
            _delete_claims(bare)(person)
        else:
            person.edit(BROKERS, "broker-of-the-edge", "service-mqtt-broker-edge")
        rig.book(first, goal(2))
    rig.assert_sound(bare)
    assert rig.books(bare) == rig.books_after(map(goal, (3, 2) if deletes else (3, 1, 2)))


@EITHER
def test_an_edited_readme_is_kept_and_asks_for_no_commit_of_its_own(
    address: str, bare: Path, person: Person, running: bool
) -> None:
    _around(address, running, [goal(1)], lambda: _edit_readme(person), [goal(2)])
    assert _kinds(bare) == ["join", "person", "join"]
    assert rig.git(bare, "show", "main:README.md") == "Ours, since today."
    assert rig.books(bare) == rig.books_after([goal(1), goal(2)])
    rig.assert_sound(bare)


@EITHER
def test_an_edited_inventory_is_carried_out_before_the_next_demand(
    address: str, bare: Path, person: Person, running: bool
) -> None:
    made = _around(address, running, [goal(1)], lambda: _move_broker(person), [goal(2)])
    assert _kinds(bare) == ["join", "person", "follow", "join"]
    first, change, follow, _ = rig.commits(bare)
    assert change.id == made
    assert dict(follow.trailers) == {
        "Operation": "follow",
        "Follows": made,
        "Since": first.id,
        "Caused-By": f"{made} Petra Platform <petra@example.org>",
        "Render-Version": "2",
    }
    changed = rig.git(bare, "diff-tree", "-r", "--name-only", "--no-commit-id", follow.id)
    assert changed.splitlines()
    assert all(path.startswith("clusters/") for path in changed.splitlines())
    assert "broker-of-the-edge" in rig.git(bare, "show", follow.id)
    assert "broker-of-the-edge" in rig.git(bare, "show", f"main:{BROKERS}")
    rig.assert_sound(bare)


@EITHER
def test_another_gitops_controller_has_everything_rendered_anew_in_one_commit(
    address: str, bare: Path, person: Person, running: bool
) -> None:
    _around(address, running, [goal(1)], lambda: _choose_argocd(person), [goal(2)])
    assert _kinds(bare) == ["join", "person", "follow", "join"]
    *_, follow, _ = rig.commits(bare)
    generated = rig.git(bare, "ls-tree", "-r", "--name-only", follow.id, "bootstrap", "clusters")
    texts = [rig.git(bare, "show", f"{follow.id}:{path}") for path in generated.splitlines()]
    assert any("kind: Application" in text for text in texts)
    assert not any("fluxcd.io" in text for text in texts)
    assert "_charts" not in generated
    rig.assert_sound(bare)


def test_a_claim_whose_file_a_person_broke_can_still_be_released(
    bare: Path, person: Person
) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        _break_claim(bare)(person)
        assert rig.book(generator, leave(1))[0].outcome == "released"
        rig.book(generator, goal(2))
    assert rig.claims(bare, "nobody") == []
    assert rig.books(bare) == rig.books_after([goal(2)])
    rig.assert_sound(bare)


def test_a_node_taken_away_is_gone_for_new_demands_once_it_is_released(
    url: str, bare: Path, person: Person
) -> None:
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        _take_vehicle01_away(bare, person)
        rig.book(generator, leave(1))
        with pytest.raises(Refused, match="vehicle01"):
            rig.book(generator, goal(1))


@EITHER
def test_an_inventory_change_is_applied_once_a_removed_node_is_released(
    address: str, bare: Path, person: Person, running: bool
) -> None:
    """One push moves a broker and removes a node in use; later demands release the node."""
    brokers = rig.git(bare, "show", f"main:{BROKERS}") + "\n"
    moved = brokers.replace("service-mqtt-broker-edge", "broker-of-the-edge")
    both = rig.without_vehicle01(bare) | {BROKERS: moved}
    released: list[rig.Goal] = [leave(1), goal(3)]
    with rig.running(address) as generator:
        rig.book(generator, goal(1), goal(2))
        person.change(both, "vehicle01 is sold, the broker moves")
        rig.book(generator, goal(6), *(released if running else []))
    if not running:
        with rig.running(address) as generator:
            rig.book(generator, *released)
    command = ["grep", "-l", "service-mqtt-broker-edge", "main", "--", "clusters"]
    standing = rig.git(bare, *command, check=False).splitlines()
    assert standing == [], "these files still have the old broker"
    rig.assert_sound(bare)


def test_a_generated_file_that_a_person_edited_is_put_right_with_the_next_commit(
    url: str, bare: Path, person: Person
) -> None:
    """`demandops check` refuses the edit. A person merges the edit nevertheless."""
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        paths = rig.git(bare, "ls-tree", "-r", "--name-only", "main", "clusters/").splitlines()
        edited = next(path for path in paths if "of-edge-fusion-1" in path)
        text = rig.git(bare, "show", f"main:{edited}") + "\n"
        person.change({edited: text + "# by hand\n"})
        rig.book(generator, goal(2))
    assert rig.git(bare, "show", f"main:{edited}") + "\n" == text
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
    url: str, bare: Path, tmp_path: Path
) -> None:
    work = tmp_path / "work"
    rig.git(tmp_path, "clone", "--quiet", str(bare), str(work))
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        rig.git(work, "switch", "--quiet", "--create", "move-broker")
        brokers = work / BROKERS
        brokers.write_text(brokers.read_text().replace("broker-edge", "broker-moved"))
        rig.git(work, "commit", "--quiet", "--all", "--message", "Move the broker")
        rig.git(work, "switch", "--quiet", "main")
        rig.git(work, "pull", "--quiet", "--ff-only")
        rig.git(work, "merge", "--quiet", "--no-ff", "--message", "Merge", "move-broker")
        rig.git(work, "push", "--quiet", "origin", "main")
        rig.book(generator, goal(2))
    first_parents = rig.git(bare, "log", "--reverse", "--first-parent", "--format=%s", "main")
    merged, followed = first_parents.splitlines()[2:4]
    assert merged == "Merge" and followed.startswith("Update ")
    assert "broker-moved" in rig.git(bare, "grep", "-h", "broker-moved", "main", "--", "clusters")
    assert rig.differing(bare) == {}


LATIN_1 = b"Na\xefve caf\xe9"


@pytest.mark.parametrize("declared", [True, False], ids=["declared", "undeclared"])
def test_commits_of_people_in_other_encodings_are_read(bare: Path, declared: bool) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        tree = rig.git(bare, "rev-parse", "main^{tree}")
        who = LATIN_1 + b" <someone@example.org> 1767225600 +0000"
        parent = rig.tip(bare).encode()
        text = b"tree %s\nparent %s\nauthor %s\ncommitter %s\n" % (tree.encode(), parent, who, who)
        text += b"encoding ISO-8859-1\n" if declared else b""
        made = subprocess.run(
            ["git", "-C", str(bare), "hash-object", "-t", "commit", "-w", "--stdin"],
            input=text + b"\n" + LATIN_1 + b"\n",
            capture_output=True,
            check=True,
        )
        rig.git(bare, "update-ref", "refs/heads/main", made.stdout.decode().strip())
        rig.book(generator, goal(2))
    with rig.running(bare) as generator:
        rig.book(generator, goal(3))
    assert _kinds(bare) == ["join", "person", "join", "join"]
    assert rig.differing(bare) == {}


# ---- a clone that is behind ----


def test_a_demand_that_seems_booked_already_is_judged_against_the_remote(
    url: str, bare: Path, person: Person
) -> None:
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        _delete_claims(bare)(person)
        receipt = rig.book(generator, goal(1))[0]
    assert receipt.outcome == "booked"
    assert rig.books(bare) == rig.books_after([goal(1)])


def test_a_node_that_seems_unknown_is_looked_for_at_the_remote(
    url: str, bare: Path, person: Person
) -> None:
    wanted = goal(1)
    wanted["connections"][0] |= {"source_node_id": "tram07", "id": "tram07/edge"}
    with rig.running(url) as generator:
        _add_node(person)
        assert rig.book(generator, wanted)[0].outcome == "booked"


def test_a_release_of_what_another_generator_booked_is_not_refused(
    url: str, bare: Path, tmp_path: Path
) -> None:
    with rig.running(url) as generator:
        with rig.running(url, data=tmp_path / "another-machine") as other:
            rig.book(other, goal(1))
        assert rig.book(generator, leave(1))[0].outcome == "released"


def test_no_demand_is_answered_from_a_stale_clone_while_the_remote_is_away(
    url: str, bare: Path, person: Person, caplog: pytest.LogCaptureFixture
) -> None:
    """Decided from the clone, ``again`` would change nothing, and ``late`` would be refused."""
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        _delete_claims(bare)(person)
        with rig.away(bare):
            again = generator.submit(goal(1))
            late = generator.submit(rig.impossible())
            rig.wait_until(
                lambda: "trying again" in caplog.text, "the generator has asked the remote in vain"
            )
            assert not again.future.done()
            assert not late.future.done()
        assert rig.receipt(again).outcome == "booked"
        with pytest.raises(InvalidInput, match="nowhere"):
            rig.receipt(late)
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
        with pytest.raises(StateRepoError) as error:
            rig.book(generator, goal(2))
        assert str(error.value) == (
            f"{address} has no branch 'main'; if it was renamed or deleted, restore it; if there "
            "is no state repo yet, push one made by `demandops init DIR`"
        )
        rig.git(bare, "branch", "--move", "trunk", "main")
        rig.book(generator, goal(2))
    rig.assert_sound(bare)
