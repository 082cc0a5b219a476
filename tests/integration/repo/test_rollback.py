"""A rollback while another generator writes, and one that a crash interrupts."""

from __future__ import annotations

from pathlib import Path

from demandops.serve import evaluation

from tests.kit import rig


def goal_of(to: str, *, drop_newer: bool) -> rig.Goal:
    who = ("A person", "person@example.org")
    return evaluation.goal(to, drop_newer=drop_newer, reason="a test", who=who)


def test_it_is_judged_on_what_others_booked_meanwhile(url: str, bare: Path) -> None:
    with rig.running(url) as one, rig.running(url) as other:
        rig.book(one, rig.goal(1))
        then, books = rig.tip(bare), rig.books(bare)
        rig.book(other, rig.goal(2))
        assert rig.outcome(one.submit(goal_of(then, drop_newer=False))) == "newer"
        assert rig.outcome(one.submit(goal_of(then, drop_newer=True))) == "restored"
        assert rig.books(bare) == books
        rig.book(other, rig.goal(3))
    rig.assert_sound(bare)


def test_what_a_crash_left_in_the_journal_is_carried_out_at_the_next_start(
    bare: Path, drivers: rig.Drivers
) -> None:
    with rig.running(bare) as generator:
        rig.book(generator, rig.goal(1))
        to, then = rig.tip(bare), rig.books(bare)
        rig.book(generator, rig.goal(2))
    wish = rig.demand("back", goal_of(to, drop_newer=True))
    drivers.start(bare, [[wish]], die_at="journaled").listen()
    assert rig.books(bare) != then
    assert rig.restart(bare)
    assert rig.books(bare) == then
    rig.assert_sound(bare)
