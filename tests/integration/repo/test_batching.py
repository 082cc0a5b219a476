"""Demands that come together get a commit each, and one push for all.

A demand that comes alone is pushed without delay.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from demandops.serve import agenda

from tests.kit import rig
from tests.kit.rig import goal


@pytest.fixture
def pushes(bare: Path) -> Path:
    """A file that gets a line for each push that the remote accepts."""
    log = bare / "pushes"
    log.touch()
    rig.hook(bare, "post-receive", f"cat >> {log}")
    return log


@pytest.fixture(autouse=True)
def _whole_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep a slow machine from publishing a batch in two parts."""
    monkeypatch.setattr(agenda, "LONGEST_EVALUATION_S", 60.0)


def _count(pushes: Path) -> int:
    return len(pushes.read_text().splitlines())


def test_demands_that_come_while_the_worker_is_busy_are_one_commit_each_and_one_push(
    url: str, bare: Path, pushes: Path
) -> None:
    with rig.running(url) as generator:
        with rig.busy(generator, goal(0), "op-0") as first:
            rest = [generator.submit(goal(n), f"op-{n}") for n in range(1, 50)]
            refused = generator.submit(rig.impossible())
            rig.wait_until_queued([*rest, refused])
        receipts = [rig.receipt(ticket) for ticket in (first, *rest)]
        assert rig.outcome(refused) == "unknown-node"
    assert _count(pushes) == 2, "the first demand must be one push, all others a second one"
    assert [receipt.commit for receipt in receipts] == [commit.id for commit in rig.commits(bare)]
    assert rig.operations(bare) == [f"op-{n}" for n in range(50)], (
        "the commits must be in the order of the demands"
    )
    assert rig.books(bare) == rig.books_after(map(goal, range(50)))
    rig.assert_sound(bare, verify_last=20)


def test_a_lone_demand_is_pushed_at_once_and_what_changes_nothing_never(
    url: str, bare: Path, pushes: Path
) -> None:
    with rig.running(url) as generator:
        for number in range(3):
            receipt = rig.receipt(generator.submit(goal(number)))
            assert rig.tip(bare) == receipt.commit, (
                "the commit must be on main when its requester is told"
            )
            assert _count(pushes) == number + 1
        (again,) = rig.book(generator, goal(1))
        assert (again.outcome, again.commit) == ("unchanged", rig.tip(bare))
        assert rig.outcome(generator.submit(rig.impossible())) == "unknown-node"
    assert _count(pushes) == 3
