"""Rollbacks while another generator writes, and a rollback that a crash interrupts."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from demandops.base.errors import Refused
from demandops.serve import evaluation
from demandops.serve.generator import Generator

from tests.kit import rig


def goal_of(to: str, *, drop_newer: bool) -> dict[str, object]:
    who = ("A person", "person@example.org")
    return evaluation.goal(to, drop_newer=drop_newer, reason="a test", who=who)


def test_it_is_judged_on_what_others_booked_meanwhile(url: str, bare: Path) -> None:
    with rig.running(url) as one, rig.running(url) as other:
        rig.book(one, rig.goal(1))
        then = rig.tip(bare)
        rig.book(other, rig.goal(2))
        ticket = one.submit(goal_of(then, drop_newer=False))
        with pytest.raises(Refused) as told:
            ticket.future.result(rig.PATIENCE_S)
        assert {found.code for found in told.value.faults} == {"newer"}
        books = rig.books(bare, then)
        receipt = rig.receipt(one.submit(goal_of(then, drop_newer=True)))
        assert (receipt.outcome, rig.books(bare)) == ("restored", books)
        rig.book(other, rig.goal(3))
    rig.assert_sound(bare)


def test_while_another_generator_writes_all_the_time(bare: Path) -> None:
    enough = threading.Event()
    failed: list[Exception] = []

    def write(generator: Generator) -> None:
        try:
            for number in range(100):
                rig.book(generator, rig.goal(number % 4), rig.leave(number % 4))
                if enough.is_set():
                    return
        except Exception as error:
            failed.append(error)

    with rig.running(str(bare)) as one, rig.running(str(bare)) as other:
        rig.book(one, rig.goal(9))
        then = rig.tip(bare)
        writer = threading.Thread(target=write, args=(other,))
        writer.start()
        try:
            receipts = [rig.receipt(one.submit(goal_of(then, drop_newer=True))) for _ in range(5)]
        finally:
            enough.set()
            writer.join(rig.PATIENCE_S)
        assert {receipt.outcome for receipt in receipts} <= {"restored", "unchanged"}
    assert [error for error in failed if not isinstance(error, Refused)] == []
    rig.assert_sound(bare)


def test_what_a_crash_left_in_the_journal_is_carried_out_at_the_next_start(
    bare: Path, drivers: rig.Drivers
) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, rig.goal(1))
        then = rig.books(bare)
        to = rig.tip(bare)
        rig.book(generator, rig.goal(2))
    wish = rig.demand("back", goal_of(to, drop_newer=True))
    drivers.start(bare, [[wish]], die_at="journaled").listen()
    assert rig.books(bare) != then
    assert rig.restart(bare)
    assert rig.books(bare) == then
    rig.assert_sound(bare)
