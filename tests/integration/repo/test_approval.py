"""Demands that need approval wait on a branch, which a person merges or deletes.

The tests run git in the person's place: merges, squashes, rebases, deleted branches.
"""

from __future__ import annotations

import threading
from contextlib import ExitStack
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import StateRepoError
from demandops.cli.main import run
from demandops.decide.state import rendered_files
from demandops.model.demand.demand import Lease
from demandops.serve import agenda, approvals
from demandops.serve.generator import Generator

from tests.kit import goals, rig
from tests.kit.git_over_http import Server
from tests.kit.limits import files_end_at
from tests.kit.repo import GitRepo, Person, branches, state_of
from tests.kit.rig import Proposed, git, goal

TITLE = "Join edge/fusion-1, vehicle01/edge, derived/station00/edge/stations/station00/pointcloud"


def put(demand: str, vehicle: int, who: str = "user", **more: Any) -> Any:
    name = f"vehicle{vehicle:02}"
    return goals.put(demand, who, topic=(f"/vehicles/{name}/ego_data", name), **more)


def head(repo: Path, branch: str) -> str:
    return git(repo, "rev-parse", branch)


def check_out(person: Person, branch: str) -> None:
    person.fetch()
    git(person.folder, "checkout", "--quiet", "-B", "work", f"origin/{branch}")


def assert_rendered(bare: Path) -> None:
    """Check that the files below clusters/ are those that ledger and configuration give."""
    wanted = rendered_files(state_of(bare)).items()
    assert GitRepo(bare).manifests() == {
        path: text
        for path, text in wanted
        if path.startswith("clusters/") and path.endswith(".yaml")
    }


def wait_until_none(bare: Path) -> None:
    rig.wait_until(lambda: not branches(bare), "no branch is left")


def test_a_demand_that_needs_approval_waits_on_a_branch_and_the_merge_completes_it(
    address: str, bare: Path, petra: Person
) -> None:
    before, heard = rig.tip(bare), threading.Event()
    with rig.running(address) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        branch = proposed.branch
        assert branches(bare) == [branch]
        assert branch.startswith("demand/demand-1-")
        assert rig.tip(bare) == before and not proposed.ticket.future.done()
        assert "(required by access domain '" in proposed.told[-1][1]
        [commit] = rig.commits(bare, f"main..{branch}")
        assert (commit.one("Proposal"), commit.one("Operation-Id")) == (branch, "op-1")
        generator.on_publish(lambda config: heard.set())
        petra.merge(branch, "--ff-only")
        receipt = rig.receipt(proposed.ticket)
        assert (receipt.outcome, receipt.commit) == ("booked", commit.id)
        assert heard.wait(rig.PATIENCE_S)
        wait_until_none(bare)
    assert [stage for stage, _ in proposed.told] == ["admitted", "booked", "proposed", "pushed"]
    assert rig.books(bare) == rig.books_after([goal(1)])
    assert rig.restart(address) is True
    assert rig.tip(bare) == commit.id, "a fast-forward merge must need no further commit"


def test_who_rejects_a_demand_tells_its_requester_why_also_while_no_generator_runs(
    address: str, bare: Path, petra: Person
) -> None:
    reject = ["--reason", "The road is closed", "--state-repo", address, "--yes"]
    told = "was turned down by Petra Platform: The road is closed (commit "
    with rig.running(address) as generator:
        one, two = (Proposed(generator, put(name, 1)) for name in ("one", "two"))
        assert run(["reject", one.branch, *reject]) == 0
        assert one.outcome() == "TurnedDown"
        assert str(one.ticket.future.exception()).startswith(told)
    assert run(["reject", two.branch, *reject]) == 0
    tip = rig.tip(bare)
    assert rig.restart(address) is True
    assert rig.tip(bare) == tip and branches(bare) == []
    records = rig.commits(bare)[-2:]
    assert [record.one("Demand-Id") for record in records] == ["one", "two"]
    assert [record.one("Requester") for record in records] == ["user", "user"]
    assert git(bare, "log", "-1", "--format=%an") == "Petra Platform"


def test_a_requester_may_have_only_so_many_proposals(
    bare: Path, petra: Person, generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(approvals, "PROPOSAL_LIMIT", 1)
    first = Proposed(generator, put("first", 1, "vehicle00")).branch
    assert rig.outcome(generator.submit(put("second", 1, "vehicle00"))) == "quota"
    assert sorted([first, Proposed(generator, put("third", 1)).branch]) == branches(bare)


def test_a_demand_waits_for_few_of_the_branches_that_are_pushed_for_others(
    bare: Path, url: str, person: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agenda, "LONGEST_EVALUATION_S", 60.0)  # so all slow ones are one batch
    monkeypatch.setattr(approvals, "_LONGEST_CHECK_S", -1)  # and each push takes longer
    slow = {"name": "slow", "requesters": ["station*"], "approval": "required"}
    person.policy(rules=[slow, {"name": "others", "requesters": ["vehicle*"]}])
    held = "grep -q heads/demand/ || exit 0; touch begun; until [ -e go ]; do sleep 0.05; done"
    rig.hook(bare, "pre-receive", held)
    waited_for = []

    def count(stage: str, text: str) -> None:
        if stage == "committed":
            waited_for.append(len(branches(bare)))

    with rig.running(url) as generator:
        with rig.busy(generator, goals.put("first")):
            proposed = [Proposed(generator, put(f"slow{n}", 1, "station00")) for n in range(12)]
            rig.wait_until_queued(each.ticket for each in proposed)
        rig.wait_until((bare / "begun").exists, "the first branch is being pushed")
        quick = generator.submit(goals.put("quick"), listener=count)
        rig.wait_until_queued([quick])
        (bare / "go").touch()
        assert rig.outcome(quick) == "booked"
        assert waited_for[0] <= 2
        assert sorted(each.branch for each in proposed) == branches(bare)


def test_a_full_disk_fails_the_demand_that_needs_it_and_nothing_else(
    bare: Path, petra: Person, generator: Generator
) -> None:
    with ExitStack() as full:

        def fill_disk(done: object) -> None:
            full.enter_context(files_end_at(generator._journal._size))

        with rig.busy(generator, goal(0)) as waiting:
            refused = generator.submit({}, "op-1")
            refused.future.add_done_callback(fill_disk)
            unlucky = generator.submit(goal(1), "op-2")
        with pytest.raises(StateRepoError, match="cannot be written"):
            rig.receipt(unlucky)
    assert Proposed(generator, goal(2), "op-3").branch in branches(bare)
    assert refused.future.done() and not waiting.future.done()


def test_a_branch_that_a_person_works_on_is_left_to_them(
    bare: Path, petra: Person, generator: Generator
) -> None:
    one = Proposed(generator, goal(0, vehicle=0))
    branch = one.branch
    check_out(petra, branch)
    git(petra.folder, "commit", "--quiet", "--allow-empty", "--message", "Looked at")
    git(petra.folder, "push", "--quiet", "origin", f"HEAD:{branch}")
    stands = head(bare, branch)
    other = Proposed(generator, goal(5, vehicle=1))
    petra.merge(other.branch)
    assert other.outcome() == "booked"
    assert head(bare, branch) == stands
    petra.merge(branch, "-X", "theirs", "-m", "Merge")
    assert one.outcome() == "booked"
    assert rig.books(bare) == rig.books_after([goal(5, vehicle=1), goal(0, vehicle=0)])
    assert_rendered(bare)


def test_a_put_of_the_same_demand_is_another_proposal_that_says_so(
    address: str, bare: Path, petra: Person
) -> None:
    with rig.running(address) as generator:
        first = Proposed(generator, put("d", 1), "op-1")
        seen = f"{first.branch} {head(bare, first.branch)}"
        second = Proposed(generator, put("d", 2), "op-2")
        assert first.outcome() == "Withdrawn"
        assert second.branch in str(first.ticket.future.exception())
        assert second.branch != first.branch and branches(bare) == [second.branch]
        [commit] = rig.commits(bare, f"main..{second.branch}")
        assert commit.one("Replaces") == seen
        text = git(bare, "log", "-1", "--format=%b", second.branch).splitlines()[0]
        assert text.startswith(f"Changed: replaces {seen};")
        assert rig.outcome(generator.submit(put("d", 3, who="stranger"))) == "not-yours"
        petra.merge(second.branch)
        assert second.outcome() == "booked"
    [claim] = rig.claims(bare, "\napplication:")
    assert "vehicle02" in rig.git(bare, "show", f"main:{claim}")
    assert rig.claims(bare, "vehicle01") == []


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
        seen = f"{old} {head(bare, old)}"
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
        wait_until_none(bare)
    assert rig.operations(bare) == ["op-1"]
    rig.assert_sound(bare)


def test_a_lease_counts_from_the_merge(bare: Path, petra: Person, generator: Generator) -> None:
    proposed = Proposed(generator, put("d", 1, lease=600), "op-1")
    branch = proposed.branch
    check_out(petra, branch)
    assert run(["check", str(petra.folder)]) == 0
    [path] = petra.folder.glob("ledger/applications/*/*/*.yaml")
    assert yaml.safe_load(path.read_text())["lease"] == {"seconds": 600, "slack": 30}, (
        "a lease must have no end before the merge"
    )
    petra.merge(branch)
    receipt = rig.receipt(proposed.ticket)
    assert (receipt.outcome, receipt.lease_s) == ("booked", 600)
    [claim] = rig.claims(bare, "\napplication:")
    until = yaml.safe_load(git(bare, "show", f"main:{claim}"))["lease"]["until"]
    followed = datetime.fromisoformat(git(bare, "log", "-1", "--format=%cI", "main")[:19])
    term = datetime.fromisoformat(until[:19]) - followed
    assert 540 <= term.total_seconds() <= 601
    assert rig.commits(bare)[-1].one("Operation") == "follow"


def test_a_merge_takes_back_nothing_of_a_lease_that_was_promised(
    bare: Path, petra: Person, generator: Generator
) -> None:
    def lease() -> Lease | None:
        (claim,) = generator.snapshot.state.ledger.application_claims("edge/d")
        return claim.lease

    petra.policy(approval="none")
    rig.book(generator, put("d", 1, lease=3600))
    before = lease()
    petra.policy(approval="required")
    proposed = Proposed(generator, put("d", 2, lease=60))
    petra.merge(proposed.branch)
    assert proposed.outcome() == "booked"
    assert before and lease() == replace(before, seconds=60)


# ---- what the server is told, and what it tells ----


@pytest.mark.parametrize("takes_options", [True, False])
def test_gitlab_is_asked_for_a_merge_request_by_push_options_if_it_takes_them(
    url: str, bare: Path, petra: Person, takes_options: bool
) -> None:
    git(bare, "config", "receive.advertisePushOptions", str(takes_options).lower())
    link = "https://git.example.org/its/state/-/merge_requests/7"
    rig.hook(
        bare,
        "pre-receive",
        'i=0; while [ "$i" -lt "${GIT_PUSH_OPTION_COUNT:-0}" ]; do\n'
        '  eval "echo \\"\\$GIT_PUSH_OPTION_$i\\"" >> options\n  i=$((i+1))\ndone\n'
        f'echo "View merge request:"; echo "  {link}"',
    )
    root = petra.read("demandops.yaml")
    forge = "proposals: {forge: gitlab, labels: [demand, its]}"
    petra.change({"demandops.yaml": f"{root}\n{forge}\n"})
    with rig.running(url) as generator:
        proposed = Proposed(generator, goal(1))
        assert [proposed.branch] == branches(bare)
        assert f" {link} " in proposed.told[-1][1]
    if takes_options:
        options = (bare / "options").read_text().splitlines()
        description = options.pop(3)
        assert [one.removeprefix("merge_request.") for one in options] == [
            *("create", "target=main", f"title={TITLE}"),
            *("remove_source_branch", "label=demand", "label=its"),
        ]
        assert description.startswith("merge_request.description=This demand needs approval")
        assert "Why: request 'demand-1', received" in description


def test_a_branch_called_demand_is_told_to_the_requester_and_delays_nothing(
    address: str, bare: Path, petra: Person
) -> None:
    git(bare, "branch", "demand", "main")
    with rig.running(address) as generator:
        with pytest.raises(StateRepoError, match="delete or rename demand"):
            rig.receipt(generator.submit(goal(1), "op-1"))
        assert "writer" not in generator.failures
        git(bare, "branch", "-D", "demand")
        assert Proposed(generator, goal(1), "op-2").branch in branches(bare)


def test_odd_ids_give_branches_that_git_takes(
    bare: Path, petra: Person, generator: Generator
) -> None:
    ids = ["", "..", "a..b/.lock", "Ä ö", "x" * 900, "-o", "@{0}"]
    tickets = [generator.submit(goal(number) | {"id": id}) for number, id in enumerate(ids)]

    def are_decided_or_wait() -> bool:
        waiting = (each.proposal and each.proposal.pushed for each in tickets)
        return all(
            waits or each.future.done() for each, waits in zip(tickets, waiting, strict=True)
        )

    rig.wait_until(are_decided_or_wait, "each is refused, or waits on a branch")
    names = branches(bare)
    assert len(names) >= 4
    assert all(len(name) < 70 and name.isascii() for name in names)


# ---- kills, connections that are cut, other generators ----


@pytest.mark.parametrize("crashes", [False, True])
def test_one_taken_back_while_the_remote_is_away_goes_when_it_is_back(
    http: str, server: Server, bare: Path, petra: Person, crashes: bool
) -> None:
    with rig.running(http) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        assert [proposed.branch] == branches(bare)
        server.faults.away = True
        assert generator.withdraw("op-1") is True
        if crashes:  # the journal has the withdrawal on disk
            generator.close(timeout=0)
        else:
            rig.wait_until(lambda: server.refused, "the generator has tried in vain")
        assert len(branches(bare)) == 1
        server.faults.away = False
        if not crashes:
            assert proposed.outcome() == "Withdrawn"
            assert branches(bare) == []
    with rig.running(http):
        wait_until_none(bare)


@pytest.mark.parametrize("deletes", [False, True])
def test_what_a_person_edits_and_squashes_is_booked(
    bare: Path, petra: Person, generator: Generator, deletes: bool
) -> None:
    """A forge's squash of two commits keeps no trailers, so only the claims show the merge."""
    proposed, other = Proposed(generator, goal(1)), Proposed(generator, goal(2))
    branch = proposed.branch
    check_out(petra, branch)
    claim, *_ = sorted(petra.folder.glob("ledger/connections/*/*/*.yaml"))
    claim.write_text(claim.read_text().replace('booked: "20', 'booked: "19'))
    git(petra.folder, "commit", "--quiet", "--all", "--message", "Edit it")
    git(petra.folder, "push", "--quiet", "origin", f"HEAD:{branch}")
    petra.squash(branch, "Squashed")
    if deletes:
        petra.delete(branch)
    assert proposed.outcome() == "booked"
    assert other.branch in branches(bare)
    assert_rendered(bare)
