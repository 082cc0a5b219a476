"""Demands that need approval wait on a branch, which a person merges or deletes.

The tests run git in the person's place: merges, squashes, rebases, deleted branches.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import Refused, ShuttingDown, StateRepoError, TurnedDown, Withdrawn
from demandops.model.demand.claim import Lease
from demandops.serve.approvals import approvals
from demandops.serve.queue import Ticket

from tests.kit import goals, rig
from tests.kit.chance import IN_FULL
from tests.kit.generator import Proposed
from tests.kit.git_over_http import Server
from tests.kit.limits import files_end_at
from tests.kit.repo import Person, branches
from tests.kit.rig import Gate, Goal, git, goal, leave


def test_a_demand_that_needs_approval_waits_on_a_branch_and_the_merge_completes_it(
    address: str, bare: Path, petra: Person
) -> None:
    before = rig.tip(bare)
    with rig.running(address) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        branch = proposed.branch
        assert branches(bare) == [branch]
        assert branch.startswith("demand/demand-1-")
        assert rig.tip(bare) == before and not proposed.ticket.future.done()
        assert "(required by access domain '" in proposed.told[-1][1]
        [commit] = rig.commits(bare, f"main..{branch}")
        assert dict(commit.trailers)["Proposal"] == branch
        assert commit.one("Operation-Id") == "op-1"
        petra.merge(branch, "--ff-only")
        receipt = rig.receipt(proposed.ticket)
        assert (receipt.outcome, receipt.commit) == ("booked", commit.id)
        rig.wait_until(lambda: not branches(bare), "the merged branch is deleted")
    assert [stage for stage, _ in proposed.told] == ["admitted", "booked", "proposed", "pushed"]
    assert rig.books(bare) == rig.books_after([goal(1)])
    assert rig.restart(address) is True
    assert rig.tip(bare) == commit.id, "a fast-forward merge must need no further commit"


Way = Callable[[Person, str], None]


@pytest.mark.parametrize(
    ("way", "moved"),
    [
        pytest.param(lambda p, b: p.merge(b, "--ff"), False, id="fast-forward"),
        pytest.param(lambda p, b: p.merge(b, "--no-ff", "-m", "Merge it"), True, id="merge-commit"),
        pytest.param(lambda p, b: p.squash(b, "Its trailers are lost"), True, id="squash"),
        pytest.param(
            lambda p, b: p.squash(b, f"Squashed\n\n{git(p.bare, 'log', '-1', '--format=%B', b)}"),
            False,
            id="squash-with-trailers",
        ),
        pytest.param(Person.rebase, False, id="rebase"),
        pytest.param(Person.rebase, True, id="rebase-main-moved-on"),
    ],
)
def test_however_it_is_merged_the_demand_is_booked_and_the_files_fit(
    bare: Path, petra: Person, way: Way, moved: bool
) -> None:
    with rig.running(bare) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        branch = proposed.branch
        if moved:
            petra.change({"inventory/README.md": "Ours"})
        way(petra, branch)
        assert proposed.outcome() == "booked"
        rig.wait_until(lambda: not branches(bare), "the merged branch is deleted")
    assert rig.books(bare) == rig.books_after([goal(1)])
    assert_rendered(bare)


def assert_rendered(bare: Path) -> None:
    """Check that the files below clusters/ are those that ledger and configuration give."""
    import pygit2
    from demandops.decide.state import rendered_files
    from demandops.repo.git import tree as trees
    from demandops.repo.load import snapshot as snapshots

    repo = pygit2.Repository(str(bare))
    state = snapshots.load(repo, repo.head.target).state
    stands = trees.texts(repo.revparse_single("main").peel(pygit2.Tree), ("clusters",))
    stands = {path: text for path, text in stands.items() if path.endswith(".yaml")}
    wanted = {p: t for p, t in rendered_files(state).items() if p.startswith("clusters/")}
    assert stands == {path: text for path, text in wanted.items() if path.endswith(".yaml")}


def test_a_requester_may_have_only_so_many_proposals(
    bare: Path, petra: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    def of(who: str, name: str) -> Goal:
        link = {"id": name, "source": "vehicle00", "target": "edge", "topics": [{"source": "/a"}]}
        return {"kind": "Demand", "demand": name, "requesters": [who], "connections": [link]}

    monkeypatch.setattr(approvals, "PROPOSAL_LIMIT", 1)
    with rig.running(bare) as generator:
        branch = Proposed(generator, of("vehicle00", "first")).branch
        with pytest.raises(Refused, match=r"^requester 'vehicle00' already has 1 proposals"):
            rig.receipt(generator.submit(of("vehicle00", "second")))
        other = Proposed(generator, of("vehicle01", "third"))
        assert sorted([branch, other.branch]) == branches(bare)


@pytest.mark.nightly  # whose turn comes first depends on how fast the machine is
def test_a_demand_waits_for_few_of_the_branches_that_are_pushed_for_others(
    bare: Path, person: Person
) -> None:
    slow = {"name": "slow", "requesters": ["station*"], "approval": "required"}
    person.policy(rules=[slow, {"name": "others", "requesters": ["vehicle*"]}])
    held = "grep -q heads/demand/ || exit 0; touch begun; until [ -e go ]; do sleep 0.05; done"
    rig.hook(bare, "pre-receive", held)
    waited_for = []

    def count(stage: str, text: str) -> None:
        if stage == "committed":
            waited_for.append(len(branches(bare)))

    with rig.running(f"file://{bare}") as generator:
        proposed = [
            Proposed(generator, goals.put(f"slow{number}", "station00")) for number in range(12)
        ]
        rig.wait_until((bare / "begun").exists, "the first branch is being pushed")
        quick = generator.submit(goals.put("quick", "vehicle00"), listener=count)
        rig.wait_until_queued([quick])
        (bare / "go").touch()
        assert rig.receipt(quick).outcome == "booked"
        assert waited_for[0] < 10
        assert sorted(each.branch for each in proposed) == branches(bare)
        rig.book(generator, goals.put("another", "vehicle00"))


def test_a_deleted_branch_turns_the_demand_down(url: str, bare: Path, petra: Person) -> None:
    before = rig.tip(bare)
    with rig.running(url) as generator:
        proposed = Proposed(generator, goal(1))
        branch = proposed.branch
        petra.delete(branch)
        with pytest.raises(TurnedDown) as error:
            rig.receipt(proposed.ticket)
    assert str(error.value) == f"was turned down: {branch} is gone and was not merged"
    assert (rig.tip(bare), branches(bare)) == (before, [])
    assert rig.restart(url) is True
    assert branches(bare) == []


def test_a_demand_that_waits_can_be_taken_back(url: str, bare: Path, petra: Person) -> None:
    with rig.running(url) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        assert [proposed.branch] == branches(bare)
        assert generator.withdraw("op-1") is True
        with pytest.raises(Withdrawn):
            rig.receipt(proposed.ticket)
        assert branches(bare) == []
    assert rig.claims(bare) == []


def test_a_full_disk_fails_the_demand_that_needs_it_and_nothing_else(
    bare: Path, petra: Person
) -> None:
    gate = Gate()
    with rig.running(bare) as generator, ExitStack() as full:

        def fill_disk(done: object) -> None:
            full.enter_context(files_end_at(generator._slot.journal._size))

        waiting = generator.submit(goal(0), "op-0", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        refused = generator.submit({}, "op-1")
        refused.future.add_done_callback(fill_disk)
        unlucky = generator.submit(goal(1), "op-2")
        gate.open.set()
        with pytest.raises(Refused):
            rig.receipt(refused)
        with pytest.raises(StateRepoError, match="cannot be written"):
            rig.receipt(unlucky)
        full.close()
        assert Proposed(generator, goal(2), "op-3").branch in branches(bare)
        assert not waiting.future.done()


def test_a_proposal_outlives_the_generator(url: str, bare: Path, petra: Person) -> None:
    with rig.running(url) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        branch = proposed.branch
        stands = git(bare, "rev-parse", branch)
    with pytest.raises(ShuttingDown):
        rig.receipt(proposed.ticket)
    with rig.running(url) as generator:
        again = Proposed(generator, goal(2), "op-2")  # it comes after op-1, so op-1 was handled
        other = again.branch
        assert sorted(branches(bare)) == sorted([branch, other])
        assert git(bare, "rev-parse", branch) == stands, "the branch was pushed again"
        assert generator.withdraw("op-1") is True, "the second generator must know the operation"
        rig.wait_until(lambda: branches(bare) == [other], "the branch is deleted")


def test_decisions_made_while_no_generator_runs_take_effect_at_the_next_start(
    url: str, bare: Path, petra: Person
) -> None:
    with rig.running(url) as generator:
        taken, refused = (Proposed(generator, goal(n), f"op-{n}") for n in (1, 2))
        yes, no = taken.branch, refused.branch
    petra.merge(yes)
    petra.delete(no)
    with rig.running(url) as generator:
        rig.wait_until(lambda: branches(bare) == [], "the merged branch is deleted")
        rig.wait_until(lambda: generator.operations == (), "both demands are answered")
    assert rig.books(bare) == rig.books_after([goal(1)])
    assert branches(bare) == []


@pytest.mark.parametrize("how", ["generator-runs", "merged-while-away", "rebased-while-away"])
def test_two_proposals_from_one_tip_give_what_two_demands_give(
    bare: Path, petra: Person, how: str
) -> None:
    """Both proposals change the same fusion. Once one proposal is merged, the other conflicts."""
    one, two = goal(0, vehicle=0), goal(5, vehicle=1)
    with rig.running(bare) as generator:
        first, second = Proposed(generator, one, "op-1"), Proposed(generator, two, "op-2")
        a, b = first.branch, second.branch
        stood = git(bare, "rev-parse", b)
        if how == "generator-runs":
            petra.merge(a, "--no-ff", "-m", "First")
            assert first.outcome() == "booked"
            rig.wait_until(
                lambda: git(bare, "rev-parse", b) != stood, "the second branch is rebuilt"
            )
            petra.merge(b, "--no-ff", "-m", "Second")
            assert second.outcome() == "booked"
    if how == "merged-while-away":
        petra.merge(a, "--no-ff", "-m", "First")
        petra.merge(b, "--no-ff", "-m", "Second", "-X", "theirs")
    elif how == "rebased-while-away":
        petra.rebase(a)
        petra.rebase(b, "-X", "theirs")
    if how != "generator-runs":
        with pytest.raises(AssertionError):
            assert_rendered(bare)
        assert rig.restart(bare) is True
    assert rig.books(bare) == rig.books_after([one, two])
    assert_rendered(bare)


def test_a_proposal_that_still_fits_is_left_where_it_is(bare: Path, petra: Person) -> None:
    with rig.running(bare) as generator:
        first = Proposed(generator, goal(1, vehicle=1))
        stood = git(bare, "rev-parse", first.branch)
        petra.change({"inventory/README.md": "Ours"})
        second = Proposed(generator, goal(2, vehicle=2))
        assert second.branch != first.branch
        tip = rig.tip(bare)
        rig.wait_until(lambda: str(generator.snapshot.commit) == tip, "the generator follows main")
        assert git(bare, "rev-parse", first.branch) == stood


def test_a_branch_that_a_person_works_on_is_left_to_them(bare: Path, petra: Person) -> None:
    with rig.running(bare) as generator:
        one = Proposed(generator, goal(0, vehicle=0))
        branch = one.branch
        petra.fetch()
        git(petra.folder, "checkout", "--quiet", "-B", "work", f"origin/{branch}")
        git(petra.folder, "commit", "--quiet", "--allow-empty", "--message", "Looked at")
        git(petra.folder, "push", "--quiet", "origin", f"HEAD:{branch}")
        stands = git(bare, "rev-parse", branch)
        other = Proposed(generator, goal(5, vehicle=1))
        petra.merge(other.branch)
        assert other.outcome() == "booked"
        assert git(bare, "rev-parse", branch) == stands
        petra.fetch()
        git(petra.folder, "merge", "--quiet", "-X", "theirs", "-m", "Merge", f"origin/{branch}")
        git(petra.folder, "push", "--quiet", "origin", "HEAD:main")
        assert one.outcome() == "booked"
    assert rig.books(bare) == rig.books_after([goal(5, vehicle=1), goal(0, vehicle=0)])
    assert_rendered(bare)


def test_the_same_request_sent_twice_waits_on_one_branch(bare: Path, petra: Person) -> None:
    with rig.running(bare) as generator:
        first = Proposed(generator, goal(1), "op-1")
        branch = first.branch
        second = Proposed(generator, goal(1), "op-2")
        assert second.branch == branch
        assert branches(bare) == [branch]
        assert len(rig.commits(bare, f"main..{branch}")) == 1
        petra.merge(branch)
        assert (first.outcome(), second.outcome()) == ("booked", "booked")


def test_a_release_of_what_waits_takes_the_branch_away(bare: Path, petra: Person) -> None:
    with rig.running(bare) as generator:
        proposed = Proposed(generator, goal(1))
        assert [proposed.branch] == branches(bare)
        assert rig.book(generator, leave(1))[0].outcome == "released"
        assert branches(bare) == []
        with pytest.raises(Withdrawn, match="released by a later request"):
            rig.receipt(proposed.ticket)
        with pytest.raises(Refused):
            rig.book(generator, leave(1))


def test_a_release_right_behind_the_demand_leaves_no_branch(bare: Path, petra: Person) -> None:
    gate = rig.Gate()
    with rig.running(bare) as generator:
        generator.submit(leave(3), listener=rig.Stages())
        held = generator.submit(goal(2), "op-0", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        asked, gone = generator.submit(goal(1), "op-1"), generator.submit(leave(1), "op-2")
        gate.open.set()
        assert rig.receipt(gone).outcome == "released"
        with pytest.raises(Withdrawn):
            rig.receipt(asked)
        rig.wait_until(lambda: len(branches(bare)) == 1, "only the other demand waits")
        generator.withdraw("op-0")
        with pytest.raises(Withdrawn):
            rig.receipt(held)


TWO = """apiVersion: demandops/v1
kind: Override
reason: More for a test
owner: perception-team
select:
  - services: ["*"]
replicas: 2
"""


def put(demand: str, vehicle: int, who: str = "user", **more: Any) -> Any:
    name = f"vehicle{vehicle:02}"
    return goals.put(demand, who, topic=(f"/vehicles/{name}/ego_data", name), **more)


def test_a_put_of_the_same_demand_is_another_proposal_that_says_so(
    address: str, bare: Path, petra: Person
) -> None:
    with rig.running(address) as generator:
        first = Proposed(generator, put("d", 1), "op-1")
        seen = f"{first.branch} {git(bare, 'rev-parse', first.branch)}"
        second = Proposed(generator, put("d", 2), "op-2")
        with pytest.raises(Withdrawn, match=f"replaced by a later demand .*: {second.branch}"):
            rig.receipt(first.ticket)
        assert second.branch != first.branch and branches(bare) == [second.branch]
        [commit] = rig.commits(bare, f"main..{second.branch}")
        assert commit.one("Replaces") == seen
        head = git(bare, "log", "-1", "--format=%b", second.branch).splitlines()[0]
        assert head == f"Changed: replaces {seen}; no approval of that counts here."
        with pytest.raises(Refused, match="is a demand of user"):
            rig.receipt(generator.submit(put("d", 3, who="stranger")))
        petra.merge(second.branch)
        assert second.outcome() == "booked"
    [claim] = [path for path in rig.claims(bare) if "/applications/" in path]
    assert "vehicle02" in git(bare, "show", f"main:{claim}")
    assert "vehicle01" not in git(bare, "show", f"main:{claim}")


NO_DELETION = 'case "$1 $3" in refs/heads/demand/*\\ 00000000*) exit 1;; esac'


def test_who_merges_what_was_approved_before_the_change_gets_just_that(
    bare: Path, url: str, petra: Person
) -> None:
    """The branch is merged after the demand was changed, and before the generator deletes it."""
    rig.hook(bare, "update", NO_DELETION)
    with rig.running(url, fetch_interval=0.1) as generator:
        first = Proposed(generator, put("d", 1), "op-1")
        old = first.branch
        second = Proposed(generator, put("d", 2), "op-2")
        new = second.branch
        assert sorted(branches(bare)) == sorted([old, new])
        stood = git(bare, "rev-parse", new)
        petra.merge(old)
        assert first.outcome() == "booked"
        assert not second.ticket.future.done()
        [claim] = [path for path in rig.claims(bare) if "/applications/" in path]
        assert "vehicle01" in git(bare, "show", f"main:{claim}")
        rig.wait_until(lambda: git(bare, "rev-parse", new) != stood, "the other one is rebuilt")
        petra.merge(new)
        assert second.outcome() == "booked"
    assert rig.operations(bare) == ["op-1", "op-2"]


def test_a_release_takes_away_what_was_replaced_too(bare: Path, url: str, petra: Person) -> None:
    """Else somebody could merge the replaced branch after the release was answered."""
    hook = rig.hook(bare, "update", NO_DELETION)
    with rig.running(url, fetch_interval=0.1) as generator:
        first = Proposed(generator, put("d", 1), "op-1")
        assert [first.branch] == branches(bare)
        second = Proposed(generator, put("d", 2), "op-2")
        assert len({first.branch, second.branch}) == len(branches(bare)) == 2
        hook.unlink()
        release = {"kind": "Demand", "demand": "d", "operation": "release", "requesters": ["user"]}
        assert rig.book(generator, release)[0].outcome == "released"
        assert branches(bare) == []
        for each in (first, second):
            with pytest.raises(Withdrawn):
                rig.receipt(each.ticket)


def test_a_change_that_is_taken_back_at_once_leaves_what_waited(bare: Path, petra: Person) -> None:
    gate = Gate()
    with rig.running(bare) as generator:
        first = Proposed(generator, put("d", 1), "op-1")
        assert [first.branch] == branches(bare)
        changed = generator.submit(put("d", 2), "op-2", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        generator.withdraw("op-2")
        gate.open.set()
        with pytest.raises(Withdrawn):
            rig.receipt(changed)
        assert branches(bare) == [first.branch]
        petra.merge(first.branch)
        assert first.outcome() == "booked"


def test_the_same_put_sent_twice_waits_on_one_branch(bare: Path, petra: Person) -> None:
    with rig.running(bare) as generator:
        first = Proposed(generator, put("d", 1))
        stands = git(bare, "rev-parse", first.branch)
        second = Proposed(generator, put("d", 1))
        assert (second.branch, branches(bare)) == (first.branch, [first.branch])
        assert git(bare, "rev-parse", first.branch) == stands
        petra.merge(first.branch)
        assert (first.outcome(), second.outcome()) == ("booked", "booked")


def test_a_demand_that_main_would_place_elsewhere_is_another_proposal(
    bare: Path, url: str, petra: Person
) -> None:
    """Who approved it on one node has not approved it on another."""
    nodes = petra.read("inventory/nodes.yaml")
    for id in ("edge", "cloud"):
        nodes = nodes.replace(f"  - id: {id}\n", f"  - id: {id}\n    capabilities: [gpu]\n")
    petra.change({"inventory/nodes.yaml": nodes})
    demand = put("d", 1, connect="mqtt")
    del demand["applications"][0]["node"]
    demand["applications"][0]["place"] = {"capabilities": ["gpu"]}
    with rig.running(url, fetch_interval=0.1) as generator:
        proposed = Proposed(generator, demand, "op-1")
        old = proposed.branch
        seen = f"{old} {git(bare, 'rev-parse', old)}"
        was_on = "cloud" if "object-fusion on cloud" in git(bare, "log", "-1", old) else "edge"
        drained = nodes.replace(f"  - id: {was_on}\n", f"  - id: {was_on}\n    drained: true\n")
        petra.change({"inventory/nodes.yaml": drained})
        rig.wait_until(lambda: old not in branches(bare), "the first branch is deleted")
        rig.wait_until(lambda: proposed.branch != old, "the requester is told")
        assert branches(bare) == [proposed.branch]
        [commit] = rig.commits(bare, f"main..{proposed.branch}")
        assert (commit.one("Operation-Id"), commit.one("Replaces")) == ("op-1", seen)
        petra.merge(proposed.branch)
        assert proposed.outcome() == "booked"
        rig.wait_until(lambda: branches(bare) == [], "the merged branch is deleted")
    assert rig.operations(bare) == ["op-1"]
    rig.assert_sound(bare)


def test_a_put_right_behind_a_release_is_proposed_anew(bare: Path, petra: Person) -> None:
    gate, gone = rig.Gate(), {"kind": "Demand", "operation": "release", "demand": "d"}
    with rig.running(bare) as generator:
        first = Proposed(generator, put("d", 1), "op-1")
        before = first.branch
        held = generator.submit(goal(2), "op-0", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        released = generator.submit({**gone, "requesters": ["user"]}, "op-2")
        second = Proposed(generator, put("d", 2), "op-3")
        gate.open.set()
        assert rig.receipt(released).outcome == "released"
        with pytest.raises(Withdrawn):
            rig.receipt(first.ticket)
        assert second.branch in branches(bare)
        assert before not in branches(bare)
        petra.merge(second.branch)
        assert second.outcome() == "booked"
        generator.withdraw("op-0")
        with pytest.raises(Withdrawn):
            rig.receipt(held)


def test_a_lease_counts_from_the_merge(bare: Path, petra: Person) -> None:
    with rig.running(bare) as generator:
        proposed = Proposed(generator, put("d", 1, lease=600), "op-1")
        branch = proposed.branch
        names = git(bare, "ls-tree", "-r", "--name-only", branch, "ledger/applications/")
        path = next(line for line in names.splitlines() if line.endswith(".yaml"))
        claim = yaml.safe_load(git(bare, "show", f"{branch}:{path}"))
        assert claim["lease"] == {"seconds": 600, "slack": 30}, (
            "a lease must have no end before the merge"
        )
        petra.merge(branch)
        receipt = rig.receipt(proposed.ticket)
        assert (receipt.outcome, receipt.lease_s) == ("booked", 600)
    lease = yaml.safe_load(git(bare, "show", f"main:{path}"))["lease"]
    followed = git(bare, "log", "-1", "--format=%cI", "main")
    end, began = lease["until"][:19], followed[:19]
    from datetime import datetime

    term = datetime.fromisoformat(end) - datetime.fromisoformat(began)
    assert 540 <= term.total_seconds() <= 601
    assert rig.commits(bare)[-1].one("Operation") == "follow"


def test_a_merge_takes_back_nothing_of_a_lease_that_was_promised(bare: Path, petra: Person) -> None:
    petra.policy(approval="none")
    with rig.running(bare) as generator:

        def lease() -> Lease | None:
            (claim,) = generator.snapshot.state.ledger.application_claims("edge/d")
            return claim.lease

        rig.book(generator, put("d", 1, lease=3600))
        before = lease()
        petra.policy(approval="required")
        proposed = Proposed(generator, put("d", 2, lease=60))
        petra.merge(proposed.branch)
        assert proposed.outcome() == "booked"
        after = lease()
    assert before and after == replace(before, seconds=60)


def test_a_demand_that_main_makes_impossible_is_refused_and_its_branch_goes(
    bare: Path, petra: Person
) -> None:
    with rig.running(bare) as generator:
        first = goal(0)
        second = goal(5)
        second["apps"][0]["header"]["node_id"] = "cloud"
        one, two = Proposed(generator, first), Proposed(generator, second)
        gone = two.branch
        petra.merge(one.branch)
        assert one.outcome() == "booked"
        with pytest.raises(Refused, match="contradicts an existing claim"):
            rig.receipt(two.ticket)
        rig.wait_until(lambda: gone not in branches(bare), "the branch is deleted")


def test_what_was_merged_before_it_was_replaced_is_booked(bare: Path, petra: Person) -> None:
    with rig.running(bare) as generator:
        first, gate = Proposed(generator, put("d", 1), "op-1"), Gate()
        branch = first.branch
        generator.submit(put("d", 2), "op-2", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        petra.merge(branch)
        gate.open.set()
        assert first.outcome() == "booked"
    rig.assert_sound(bare)


def test_a_branch_that_cannot_be_rebuilt_can_still_be_merged(
    bare: Path, url: str, petra: Person
) -> None:
    with rig.running(url, fetch_interval=0.1) as generator:
        proposed = Proposed(generator, put("d", 1), "op-1")
        branch = proposed.branch
        rig.hook(bare, "update", 'case "$1" in refs/heads/demand/*) exit 1;; esac')
        petra.override(two=TWO)
        failed = f"rebuilding {branch}"
        rig.wait_until(lambda: failed in generator.failures, "the push is denied")
        petra.merge(branch)
        assert proposed.outcome() == "booked"
    assert rig.operations(bare) == ["op-1"]


def test_what_a_branch_still_has_is_not_said_to_be_replaced(
    bare: Path, url: str, petra: Person
) -> None:
    with rig.running(url, fetch_interval=0.1) as generator:
        first = Proposed(generator, put("d", 1), "op-1")
        branch = first.branch
        rig.hook(bare, "update", 'case "$1" in refs/heads/demand/*) exit 1;; esac')
        generator.submit(put("d", 2), "op-2")
        failed = f"rebuilding {branch}"
        rig.wait_until(lambda: failed in generator.failures, "the push is denied")
        assert not first.ticket.future.done()
        petra.merge(branch)
        assert first.outcome() == "booked"
    assert rig.operations(bare) == ["op-1"]


def test_what_replaced_a_proposal_waits_on_after_two_restarts(
    bare: Path, url: str, petra: Person
) -> None:
    with rig.running(url) as generator:
        old = Proposed(generator, put("d", 1), "op-1").branch
        hook = rig.hook(bare, "update", NO_DELETION)
        branch = Proposed(generator, put("d", 2), "op-2").branch
        rig.wait_until(lambda: generator.failures, "the deletion is denied")
    assert sorted(branches(bare)) == sorted([old, branch])
    hook.unlink()
    with rig.running(url):
        rig.wait_until(lambda: branches(bare) == [branch], "the replaced branch is deleted")
    assert rig.restart(url)
    petra.merge(branch)
    assert rig.restart(url)
    assert rig.operations(bare) == ["op-2"]


def test_a_policy_that_asks_no_more_lets_what_waits_through(bare: Path, petra: Person) -> None:
    with rig.running(bare) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        assert [proposed.branch] == branches(bare)
        petra.policy(approval="none")
        receipt = rig.receipt(proposed.ticket)
        assert receipt.outcome == "booked"
        assert branches(bare) == []
    assert rig.operations(bare) == ["op-1"]
    rig.assert_sound(bare)


def test_demands_that_need_none_go_on_meanwhile(bare: Path, petra: Person) -> None:
    petra.policy(
        approval="none",
        rules=[
            {"name": "visitors", "requesters": ["user1", "station00"], "approval": "required"},
            {"name": "residents", "requesters": ["user2", "station00"]},
        ],
    )
    with rig.running(bare) as generator:
        waits = Proposed(generator, goal(1))
        assert "rule 'visitors' of access domain" in waits.told[-1][1] if waits.branch else False
        assert rig.book(generator, goal(2))[0].outcome == "booked"
        assert not waits.ticket.future.done()
    assert rig.books(bare) == rig.books_after([goal(2)])


@pytest.fixture
def hooked(bare: Path) -> Iterator[Path]:
    """The file in which the server's hook lists the refs and push options that it gets."""
    git(bare, "config", "receive.advertisePushOptions", "true")
    log = bare / "options"
    rig.hook(
        bare,
        "pre-receive",
        'read old new ref\necho "$ref" >> options\ni=0\n'
        'while [ "$i" -lt "${GIT_PUSH_OPTION_COUNT:-0}" ]; do\n'
        '  eval "echo \\"  \\$GIT_PUSH_OPTION_$i\\"" >> options\n  i=$((i+1))\ndone\n'
        'case "$ref" in refs/heads/demand/*) echo "View merge request for $ref:"\n'
        'echo "  https://git.example.org/its/state/-/merge_requests/7";; esac',
    )
    yield log


def test_gitlab_is_asked_for_a_merge_request_by_push_options(
    url: str, bare: Path, petra: Person, hooked: Path
) -> None:
    root = git(bare, "show", "main:demandops.yaml")
    text = f"{root}\nproposals: {{forge: gitlab, labels: [demand, its]}}\n"
    petra.change({"demandops.yaml": text})
    with rig.running(url) as generator:
        proposed = Proposed(generator, goal(1))
        branch = proposed.branch
        link = "https://git.example.org/its/state/-/merge_requests/7"
        assert f" {link} " in proposed.told[-1][1]
    options = hooked.read_text().splitlines()
    assert options[0] == f"refs/heads/{branch}"
    assert options[1:4] == [
        "  merge_request.create",
        "  merge_request.target=main",
        "  merge_request.title=Join edge/fusion-1, vehicle01/edge",
    ]
    assert options[4].startswith(
        "  merge_request.description=This demand needs approval, as required"
    )
    assert "Why: request 'demand-1', received" in options[4]
    assert options[5:] == [
        "  merge_request.remove_source_branch",
        "  merge_request.label=demand",
        "  merge_request.label=its",
    ]


def test_a_server_that_takes_no_push_options_gets_the_branch_without(
    url: str, bare: Path, petra: Person
) -> None:
    root = git(bare, "show", "main:demandops.yaml")
    petra.change({"demandops.yaml": f"{root}\nproposals: {{forge: gitlab}}\n"})
    with rig.running(url) as generator:
        assert [Proposed(generator, goal(1)).branch] == branches(bare)


def test_a_server_that_refuses_the_branch_is_told_to_the_requester(
    url: str, bare: Path, petra: Person
) -> None:
    rig.hook(bare, "pre-receive", "echo 'no branches here' >&2; exit 1")
    refused = pytest.raises(StateRepoError, match=r"rejects the push: .*no branches here")
    with rig.running(url) as generator, refused:
        rig.receipt(generator.submit(goal(1)))
    assert branches(bare) == []


@pytest.mark.parametrize(
    ("address", "point"),
    [
        *(("file-url", f"journaled:{times}") for times in ((1, 2, 3, 4) if IN_FULL else (1, 4))),
        *product(("embedded", "file-url"), ("proposing", "proposed")),
    ],
    indirect=["address"],
)
def test_killed_while_proposing_there_is_one_branch_after_the_restart(
    drivers: rig.Drivers, address: str, bare: Path, petra: Person, point: str
) -> None:
    drivers.start(address, [[rig.demand("one", goal(1))]], die_at=point).listen()
    with rig.running(address) as generator:
        other = Proposed(generator, goal(2))
        other_branch = other.branch
        rig.wait_until(lambda: len(branches(bare)) == 2, "both demands wait")
        [branch] = [one for one in branches(bare) if one != other_branch]
        assert [c.one("Operation-Id") for c in rig.commits(bare, f"main..{branch}")] == ["op-one"]
        petra.merge(branch)
        rig.wait_until(lambda: branches(bare) == [other_branch], "the generator has seen the merge")
    assert rig.books(bare) == rig.books_after([goal(1)])


def test_killed_before_the_branch_of_a_released_demand_is_deleted_it_goes_at_the_restart(
    drivers: rig.Drivers, url: str, bare: Path, petra: Person
) -> None:
    lanes = [[rig.demand("leave", leave(1))]]
    opening = rig.demand("join", goal(1))
    drivers.start(url, lanes, opening=opening, die_at="retracting").listen()
    with rig.running(url) as generator:
        rig.wait_until(lambda: not branches(bare), "the branch is deleted")
        rig.wait_until(lambda: generator.operations == (), "both demands are answered")
    assert rig.claims(bare) == []


def test_two_generators_that_take_one_demand_agree_once_it_is_merged(
    url: str, bare: Path, petra: Person
) -> None:
    with rig.running(url) as one, rig.running(url) as two:
        first, second = Proposed(one, goal(1)), Proposed(two, goal(1))
        assert len({first.branch, second.branch}) == 2
        petra.merge(first.branch)
        assert (first.outcome(), second.outcome()) == ("booked", "booked")
        rig.wait_until(lambda: branches(bare) == [], "neither branch is left")
    assert rig.books(bare) == rig.books_after([goal(1)])


def test_one_taken_back_while_the_remote_is_away_goes_when_it_is_back(
    http: str, server: Server, bare: Path, petra: Person
) -> None:
    with rig.running(http) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        assert [proposed.branch] == branches(bare)
        server.faults.away = True
        assert generator.withdraw("op-1") is True
        rig.wait_until(lambda: server.refused, "the generator has tried in vain")
        server.faults.away = False
        with pytest.raises(Withdrawn):
            rig.receipt(proposed.ticket)
        assert branches(bare) == []


def test_a_push_whose_answer_got_lost_makes_no_second_branch(
    http: str, server: Server, bare: Path, petra: Person
) -> None:
    with rig.running(http) as generator:
        server.faults.cut_answers = 1
        proposed = Proposed(generator, goal(1), "op-1")
        assert [proposed.branch] == branches(bare)
        petra.merge(proposed.branch)
        assert proposed.outcome() == "booked"


def _is_decided_or_waits(ticket: Ticket) -> bool:
    return ticket.future.done() or bool(ticket.proposal and ticket.proposal.pushed)


def test_odd_ids_give_branches_that_git_takes(bare: Path, petra: Person) -> None:
    with rig.running(bare) as generator:
        for number, id in enumerate(["", "..", "a..b/.lock", "Ä ö", "x" * 900, "-o", "@{0}"]):
            made = goal(number) | {"id": id}
            ticket = generator.submit(made, f"op-{number}")
            done = partial(_is_decided_or_waits, ticket)
            rig.wait_until(done, f"{id!r} is refused, or waits on a branch")
        names = branches(bare)
    assert len(names) >= 4
    assert all(len(name) < 70 and name.isascii() for name in names)


def test_what_a_request_adds_while_it_waits_is_proposed_beside_it(
    bare: Path, petra: Person
) -> None:
    """The second join adds to the first, whose branch a person may have approved already."""
    more = goal(1, vehicle=2) | {"connections": []}
    with rig.running(bare) as generator:
        first = Proposed(generator, goal(1), "op-1")
        branch = first.branch
        stands = git(bare, "rev-parse", branch)
        second = Proposed(generator, more, "op-2")
        assert sorted([branch, second.branch]) == sorted(branches(bare))
        assert git(bare, "rev-parse", branch) == stands
        petra.merge(branch)
        assert first.outcome() == "booked"
        rig.wait_until(
            lambda: git(bare, "merge-base", "main", second.branch) == stands,
            "the second branch is rebuilt on the first",
        )
        petra.merge(second.branch)
        assert second.outcome() == "booked"
    assert rig.books(bare) == rig.books_after([goal(1), more])


def test_whoever_watches_hears_of_a_merge(bare: Path, petra: Person) -> None:
    """A listener of `on_publish`, like the ROS topic of the bookkeeping, is also told of merges."""
    heard = threading.Event()
    with rig.running(bare) as generator:
        proposed = Proposed(generator, goal(1))
        branch = proposed.branch
        generator.on_publish(lambda config: heard.set())
        petra.merge(branch, "--ff-only")
        assert proposed.outcome() == "booked"
        assert heard.wait(rig.PATIENCE_S)


def test_a_proposal_passes_the_check_of_pull_requests(
    bare: Path, petra: Person, capsys: pytest.CaptureFixture[str]
) -> None:
    from demandops.cli.main import run

    with rig.running(bare) as generator:
        branch = Proposed(generator, put("d", 1, lease=600)).branch
    petra.fetch()
    git(petra.folder, "checkout", "--quiet", f"origin/{branch}")
    assert run(["check", str(petra.folder)]) == 0, capsys.readouterr()


def test_a_demand_withdrawn_right_before_a_crash_loses_its_branch_at_the_restart(
    http: str, server: Server, bare: Path, petra: Person
) -> None:
    """The journal has the withdrawal on disk before the crash."""
    with rig.running(http) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        assert [proposed.branch] == branches(bare)
        server.faults.away = True
        assert generator.withdraw("op-1") is True
        generator.close(timeout=0)
    server.faults.away = False
    assert len(branches(bare)) == 1
    with rig.running(http):
        rig.wait_until(lambda: branches(bare) == [], "the branch is deleted")
    assert rig.claims(bare) == []


def test_a_branch_called_demand_is_told_to_the_requester_and_delays_nothing(
    address: str, bare: Path, petra: Person
) -> None:
    git(bare, "branch", "demand", "main")
    with rig.running(address) as generator:
        refused = generator.submit(goal(1), "op-1")
        with pytest.raises(StateRepoError) as error:
            rig.receipt(refused)
        branch = f"{error.value}".split(" the branch ")[1].split(",")[0]
        assert str(error.value) == (
            f"{address} cannot have the branch {branch}, because it has a branch demand; delete or "
            "rename demand, then try again"
        )
        assert "writer" not in generator.failures
        git(bare, "branch", "-D", "demand")
        assert Proposed(generator, goal(1), "op-2").branch in branches(bare)


@pytest.mark.parametrize("deletes", [False, True])
def test_what_a_person_edits_and_squashes_is_booked(
    bare: Path, petra: Person, deletes: bool
) -> None:
    """A forge's squash of two commits keeps no trailers, so only the claims show the merge."""
    with rig.running(bare) as generator:
        proposed, other = Proposed(generator, goal(1)), Proposed(generator, goal(2))
        branch = proposed.branch
        petra.fetch()
        git(petra.folder, "checkout", "--quiet", "-B", "work", f"origin/{branch}")
        [claim] = petra.folder.glob("ledger/connections/*/*/*.yaml")
        claim.write_text(claim.read_text().replace("request: ", "request: edited-"))
        git(petra.folder, "commit", "--quiet", "--all", "--message", "Edit it")
        git(petra.folder, "push", "--quiet", "origin", f"HEAD:{branch}")
        petra.squash(branch, "Squashed")
        if deletes:
            petra.delete(branch)
        assert proposed.outcome() == "booked"
        assert other.branch in branches(bare)
    assert_rendered(bare)


def test_a_merge_of_what_was_replaced_books_not_what_replaced_it(bare: Path, petra: Person) -> None:
    """The person squashes ``first``, without trailers, before the generator decides ``second``."""
    link = {"id": "x", "source": "vehicle00", "target": "edge", "topics": [{"source": "/a"}]}
    made = {"kind": "Demand", "demand": "d", "requesters": ["vehicle00"], "connections": [link]}
    gate = Gate()
    with rig.running(bare) as generator:
        first = Proposed(generator, made)
        branch = first.branch
        link = {**link, "topics": [{"source": "/b"}]}
        second = generator.submit({**made, "connections": [link]}, "op-2", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        petra.squash(branch, "Squashed")
        petra.delete(branch)
        gate.open.set()
        assert first.outcome() == "booked"
        assert not second.future.done()
