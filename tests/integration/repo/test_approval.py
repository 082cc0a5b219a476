"""Demands that need approval: limits, faults, leases, and what the Git server is told."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import StateRepoError
from demandops.serve import agenda, approvals
from demandops.serve.generator import Generator

from tests.kit import goals, rig
from tests.kit.limits import files_end_at
from tests.kit.repo import Person, branches
from tests.kit.rig import Proposed, git, goal

TITLE = "Join edge/fusion-1, vehicle01/edge, derived/station00/edge/stations/station00/pointcloud"


def put(demand: str, vehicle: int, who: str = "user", **more: Any) -> Any:
    name = f"vehicle{vehicle:02}"
    return goals.put(demand, who, topic=(f"/vehicles/{name}/ego_data", name), **more)


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


# ---- what the server is told, and what it tells ----


@pytest.mark.parametrize("takes_options", [True, False])
def test_gitlab_is_asked_for_a_merge_request_by_push_options_if_it_takes_them(
    url: str, bare: Path, petra: Person, takes_options: bool
) -> None:
    git(bare, "config", "receive.advertisePushOptions", str(takes_options).lower())
    link = "https://git.example.org/its/state/-/merge_requests/7"
    told = f'echo "View merge request:"; echo "  {link}"'
    rig.hook(bare, "pre-receive", f"env | grep ^GIT_PUSH_OPTION_ | sort -V > options; {told}")
    root = petra.read("demandops.yaml")
    forge = "proposals: {forge: gitlab, labels: [demand, its]}"
    petra.change({"demandops.yaml": f"{root}\n{forge}\n"})
    with rig.running(url) as generator:
        proposed = Proposed(generator, goal(1))
        assert [proposed.branch] == branches(bare)
        assert f" {link} " in proposed.told[-1][1]
    options = (bare / "options").read_text()
    wanted = [f"title={TITLE}\n", "description=This demand needs approval", "create\n"]
    wanted += ["target=main\n", "remove_source_branch\n", "label=demand\n", "label=its\n"]
    assert all((f"=merge_request.{one}" in options) is takes_options for one in wanted), options
