"""Demands that come together get a commit each, and one push for all.

A demand that comes alone is pushed without delay.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from demandops.serve import worker

from tests.kit import rig
from tests.kit.rig import Gate, goal, leave


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
    monkeypatch.setattr(worker, "LONGEST_EVALUATION_S", 60.0)


def _count(pushes: Path) -> int:
    return len(pushes.read_text().splitlines())


def test_demands_that_come_while_the_worker_is_busy_are_one_commit_each_and_one_push(
    url: str, bare: Path, pushes: Path
) -> None:
    gate = Gate()
    with rig.running(url) as generator:
        first = generator.submit(goal(0), "op-0", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        rest = [generator.submit(goal(n), f"op-{n}") for n in range(1, 21)]
        rig.wait_until_queued(rest)
        gate.open.set()
        receipts = [rig.receipt(ticket) for ticket in (first, *rest)]
    assert _count(pushes) == 2, "the first demand must be one push, all others a second one"
    assert [receipt.commit for receipt in receipts] == [commit.id for commit in rig.commits(bare)]
    assert rig.operations(bare) == [f"op-{n}" for n in range(21)], (
        "the commits must be in the order of the demands"
    )
    assert rig.books(bare) == rig.books_after(map(goal, range(21)))
    rig.assert_sound(bare)


def test_a_lone_demand_is_pushed_at_once(url: str, bare: Path, pushes: Path) -> None:
    with rig.running(url) as generator:
        for number in range(3):
            receipt = rig.receipt(generator.submit(goal(number)))
            assert rig.tip(bare) == receipt.commit, (
                "the commit must be on main when its requester is told"
            )
            assert _count(pushes) == number + 1


def test_a_batch_of_which_nothing_changes_is_not_pushed(url: str, bare: Path, pushes: Path) -> None:
    with rig.running(url) as generator:
        rig.book(generator, goal(1))
        tip = rig.tip(bare)
        again = rig.book(generator, goal(1))[0]
        with pytest.raises(Exception, match="nowhere"):
            rig.book(generator, rig.impossible())
    assert (again.outcome, again.commit) == ("unchanged", tip)
    assert _count(pushes) == 1


def test_a_refused_demand_in_a_batch_stops_none_of_the_others(
    url: str, bare: Path, pushes: Path
) -> None:
    gate = Gate()
    with rig.running(url) as generator:
        generator.submit(goal(0), listener=gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        tickets = [generator.submit(made) for made in (goal(1), rig.impossible(), goal(2))]
        rig.wait_until_queued(tickets)
        gate.open.set()
        assert rig.receipt(tickets[0]).outcome == "booked"
        with pytest.raises(Exception, match="nowhere"):
            rig.receipt(tickets[1])
        assert rig.receipt(tickets[2]).outcome == "booked"
    assert _count(pushes) == 2
    rig.assert_sound(bare)


def test_a_batch_is_judged_in_order_a_release_behind_its_join_finds_it(bare: Path) -> None:
    gate = Gate()
    with rig.running(bare) as generator:
        generator.submit(goal(0), listener=gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        tickets = [generator.submit(made) for made in (goal(1), goal(1), leave(1), goal(1))]
        gate.open.set()
        outcomes = [rig.receipt(ticket).outcome for ticket in tickets]
    assert outcomes == ["booked", "unchanged", "released", "booked"]
    assert rig.books(bare) == rig.books_after([goal(0), goal(1)])
    rig.assert_sound(bare)


def test_more_demands_than_a_batch_holds_are_all_answered_in_order(bare: Path) -> None:
    gate = Gate()
    with rig.running(bare) as generator:
        first = generator.submit(goal(0), "op-0", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        rest = [generator.submit(goal(n), f"op-{n}") for n in range(1, 50)]
        gate.open.set()
        for ticket in (first, *rest):
            assert rig.receipt(ticket).outcome == "booked"
    assert rig.operations(bare) == [f"op-{n}" for n in range(50)]
