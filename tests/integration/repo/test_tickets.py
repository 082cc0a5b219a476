"""The generator's promises to a caller of `submit` hold whatever the caller does."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import (
    DemandOpsError,
    QueueFull,
    ShuttingDown,
    StateRepoError,
    Unsound,
    Withdrawn,
)
from demandops.base.runtime import Runtime
from demandops.repo.write.journal import JournalEntry
from demandops.serve.generator import Generator
from demandops.serve.queue import Ticket

from tests.kit import rig
from tests.kit.clock import Clock
from tests.kit.goals import put
from tests.kit.limits import files_end_at
from tests.kit.rig import Drivers, Gate, Stages, demand, goal

# ---- withdrawals ----


def test_a_demand_that_waits_can_be_taken_back_and_leaves_no_trace(
    address: str, bare: Path
) -> None:
    gate = Gate()
    with rig.running(address) as generator:
        generator.submit(goal(1), "op-1", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        stages = Stages()
        ticket = generator.submit(goal(2), "op-2", stages)
        assert generator.withdraw("op-2") is True
        assert generator.withdraw("op-2") is True, "a second withdrawal must do no harm"
        gate.open.set()
        with pytest.raises(Withdrawn):
            rig.receipt(ticket)
    assert rig.operations(bare) == ["op-1"]
    assert rig.claims(bare, "user2") == []
    assert stages.names == []
    assert rig.restart(address) is True
    assert rig.operations(bare) == ["op-1"]


@pytest.mark.parametrize("stage", ["admitted", "booked"])
def test_a_demand_can_be_taken_back_until_it_is_committed(bare: Path, stage: str) -> None:
    answers: list[bool] = []
    with rig.running(bare) as generator:

        def take_back(told: str, text: str) -> None:
            if told == stage:
                answers.append(generator.withdraw("op-1"))

        ticket = generator.submit(goal(1), "op-1", take_back)
        with pytest.raises(Withdrawn):
            rig.receipt(ticket)
        assert rig.book(generator, goal(2))[0].outcome == "booked"
    assert answers == [True]
    assert len(rig.operations(bare)) == 1
    assert rig.books(bare) == rig.books_after([goal(2)])


@pytest.mark.parametrize("stage", ["committed", "pushed"])
def test_a_committed_demand_cannot_be_taken_back(address: str, bare: Path, stage: str) -> None:
    answers: list[bool] = []
    with rig.running(address) as generator:

        def take_back(told: str, text: str) -> None:
            if told == stage:
                answers.append(generator.withdraw("op-1"))

        assert rig.receipt(generator.submit(goal(1), "op-1", take_back)).outcome == "booked"
        assert generator.withdraw("op-1") is False
        assert generator.withdraw("never-known") is False
    assert answers == [False]
    assert rig.operations(bare) == ["op-1"]


def test_taking_back_races_with_committing_and_both_agree_on_who_won(
    bare: Path, address: str
) -> None:
    with rig.running(address) as generator:
        tickets = [generator.submit(goal(n), f"op-{n}") for n in range(30)]
        taken = {n for n in range(29, -1, -1) if generator.withdraw(f"op-{n}")}
        for number, ticket in enumerate(tickets):
            if number in taken:
                with pytest.raises(Withdrawn):
                    rig.receipt(ticket)
            else:
                assert rig.receipt(ticket).outcome == "booked"
    kept = [n for n in range(30) if n not in taken]
    assert rig.operations(bare) == [f"op-{n}" for n in kept]
    assert rig.books(bare) == rig.books_after(map(goal, kept))
    rig.assert_sound(bare)


# ---- closing ----


def test_closing_finishes_what_is_in_hand(address: str, bare: Path) -> None:
    gate = Gate()
    generator = Generator(address)
    tickets = [generator.submit(goal(0), "op-0", gate)]
    assert gate.reached.wait(rig.PATIENCE_S)
    tickets += [generator.submit(goal(n), f"op-{n}") for n in range(1, 30)]
    stopped = generator.stop(rig.PATIENCE_S)
    gate.open.set()
    assert stopped.result(rig.PATIENCE_S) is True
    assert all(ticket.future.done() for ticket in tickets)
    assert rig.operations(bare) == [f"op-{n}" for n in range(30)]


def test_a_demand_after_closing_is_told_so(bare: Path) -> None:
    generator = Generator(str(bare))
    generator.close(rig.PATIENCE_S)
    ticket = generator.submit(goal(1))
    with pytest.raises(ShuttingDown) as error:
        rig.receipt(ticket)
    assert ticket.journaled.result() is False
    assert str(error.value) == "the generator is shutting down; send the demand again later"


def test_stopping_again_ends_again(bare: Path) -> None:
    generator = Generator(str(bare))
    rig.book(generator, goal(1))
    both = [generator.stop(rig.PATIENCE_S), generator.stop(rig.PATIENCE_S)]
    assert [one.result(rig.PATIENCE_S) for one in both] == [True, True]
    assert generator.close(rig.PATIENCE_S) is True
    assert generator.stop(rig.PATIENCE_S).result(rig.PATIENCE_S) is True


def test_a_demand_handed_in_while_closing_is_answered_or_not_taken(bare: Path) -> None:
    for _ in range(5):
        generator = Generator(str(bare))
        tickets: list[Ticket] = []

        def hand_in(generator: Generator = generator, tickets: list[Ticket] = tickets) -> None:
            while not (tickets and isinstance(_error(tickets[-1]), ShuttingDown)):
                tickets.append(generator.submit(goal(len(tickets) % 20)))

        thread = threading.Thread(target=hand_in, daemon=True)
        thread.start()
        rig.wait_until(tickets.__len__, "the first demand is submitted")
        assert generator.close(rig.PATIENCE_S) is True
        thread.join(rig.PATIENCE_S)
        for ticket in tickets:
            assert ticket.future.done(), "the generator closed without an answer"


def _error(ticket: Ticket) -> BaseException | None:
    return ticket.future.exception() if ticket.future.done() else None


# ---- journaling ----


def test_demands_that_arrive_during_a_sync_share_the_next_one(
    bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = threading.Event()
    syncs: list[int] = []

    def sync(file: int) -> None:
        syncs.append(file)
        assert synced.wait(rig.PATIENCE_S)

    with rig.running(bare) as generator:
        monkeypatch.setattr(os, "fdatasync", sync)
        tickets = [generator.submit(goal(0))]
        rig.wait_until(lambda: syncs, "the first demand is being synced")
        tickets += [generator.submit(goal(number)) for number in range(1, 40)]
        assert not any(ticket.journaled.done() for ticket in tickets)
        synced.set()
        assert all(ticket.journaled.result(rig.PATIENCE_S) for ticket in tickets)
        assert len(syncs) == 2
        for ticket in tickets:
            rig.receipt(ticket)


def test_a_demand_is_journaled_while_another_is_evaluated(bare: Path) -> None:
    gate = Gate()
    with rig.running(bare) as generator:
        generator.submit(goal(0), listener=gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        assert generator.submit(goal(1)).journaled.result(rig.PATIENCE_S) is True
        gate.open.set()


# ---- limits ----


def test_a_full_queue_takes_no_more_and_takes_again_when_there_is_room(bare: Path) -> None:
    gate = Gate()
    with rig.running(bare, queue_limit=3) as generator:
        first = generator.submit(goal(0), listener=gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        waiting = [generator.submit(goal(n)) for n in (1, 2, 3)]
        with pytest.raises(QueueFull) as error:
            rig.receipt(generator.submit(goal(4)))
        assert str(error.value) == "3 demands are queued already; send the demand again later"
        gate.open.set()
        for ticket in (first, *waiting):
            rig.receipt(ticket)
        assert rig.book(generator, goal(4))[0].outcome == "booked"
    assert rig.books(bare) == rig.books_after(map(goal, range(5)))


def test_a_requester_may_have_only_so_many_demands_waiting(bare: Path) -> None:
    gate = Gate()
    with rig.running(bare, requester_limit=2) as generator:
        first = generator.submit(goal(1), listener=gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        second = generator.submit(goal(1), "again")
        with pytest.raises(QueueFull, match=r"^2 demands of 'user1' .* requester_queue_limit$"):
            rig.receipt(generator.submit(goal(1), "op-3"))
        other = generator.submit(goal(2))
        gate.open.set()
        for ticket in (first, second, other):
            rig.receipt(ticket)
        assert rig.book(generator, goal(1))[0].outcome == "unchanged"


def test_a_demand_waits_for_few_slow_ones_of_another_requester(bare: Path) -> None:
    clock, gate = Clock(), Gate()
    begun, begun_before = list[str](), dict[str, int]()

    def slow(stage: str, text: str) -> None:
        if stage == "admitted":
            begun.append(text)
            clock.pass_(0.6)

    def quick(name: str, stage: str, text: str) -> None:
        if stage == "pushed":
            begun_before[name] = len(begun)

    with rig.running(bare, runtime=clock) as generator:
        first = generator.submit(put("first"), listener=gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        tickets = [first]
        for number in range(12):
            made = put(f"slow{number}", "station00")
            tickets.append(generator.submit(made, listener=slow))
        for name in ("vehicle01", "vehicle02"):
            made = put(name, name)
            tickets.append(generator.submit(made, listener=partial(quick, name)))
        gate.open.set()
        assert {rig.receipt(ticket).outcome for ticket in tickets} == {"booked"}
    assert len(begun) == 12
    assert max(begun_before.values()) <= 3


def test_demands_are_counted_while_others_come_and_go(bare: Path) -> None:
    with rig.running(bare) as generator:
        tickets = [generator.submit(goal(number % 9), f"op-{number}") for number in range(200)]
        while not all(ticket.future.done() for ticket in tickets):
            assert 0 <= generator.unpublished <= 200
        assert generator.unpublished == 0


# ---- callers that misbehave ----


def test_a_caller_that_cancels_its_future_stops_nobody_else(bare: Path) -> None:
    """`asyncio.wait_for(asyncio.wrap_future(ticket.future), …)` cancels the future on time-out."""
    gate = Gate()
    with rig.running(bare) as generator:
        first = generator.submit(goal(1), listener=gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        second = generator.submit(goal(2))
        first.future.cancel()
        second.future.cancel()
        third = generator.submit(goal(3))
        gate.open.set()
        assert rig.receipt(third).outcome == "booked"
        assert rig.receipt(generator.submit(goal(4))).outcome == "booked"
    rig.assert_sound(bare)


def test_a_listener_that_fails_stops_nothing(bare: Path) -> None:
    def fail(stage: str, text: str) -> None:
        raise RuntimeError(stage)

    with rig.running(bare) as generator:
        assert rig.receipt(generator.submit(goal(1), listener=fail)).outcome == "booked"
        assert rig.book(generator, goal(2))[0].outcome == "booked"


def test_a_done_callback_may_hand_in_the_next_demand(bare: Path) -> None:
    done = threading.Event()
    with rig.running(bare) as generator:

        def then(future: Any) -> None:
            generator.submit(goal(2)).future.add_done_callback(lambda _: done.set())

        generator.submit(goal(1)).future.add_done_callback(then)
        assert done.wait(rig.PATIENCE_S)
    assert rig.books(bare) == rig.books_after([goal(1), goal(2)])


NOT_PLAIN: list[Any] = [
    {**goal(1), "id": b"bytes"},
    {**goal(1), "apps": {1, 2}},
    {**goal(1), ("a", "b"): 1},
    object(),
    None,
    float("nan"),
    "a text",
]


def test_goals_that_are_no_plain_data_fail_alone(bare: Path) -> None:
    gate = Gate()
    with rig.running(bare) as generator:
        generator.submit(goal(0), listener=gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        before, odd = generator.submit(goal(1)), []
        for made in NOT_PLAIN:
            with suppress(DemandOpsError):  # raised now or by the ticket
                odd.append(generator.submit(made))
        after = generator.submit(goal(2))
        gate.open.set()
        for ticket in odd:
            with pytest.raises(DemandOpsError):
                rig.receipt(ticket)
        assert rig.receipt(before).outcome == "booked"
        assert rig.receipt(after).outcome == "booked"
    assert rig.restart(bare) is True
    assert rig.books(bare) == rig.books_after(map(goal, range(3)))


def test_an_operation_id_cannot_forge_a_trailer(bare: Path) -> None:
    with rig.running(bare) as generator:
        try:
            rig.receipt(generator.submit(goal(1), "op-1\nRequester: somebody else"))
        except (DemandOpsError, ValueError):
            return
    made = rig.commits(bare)[-1]
    assert ("Requester", "somebody else") not in made.trailers


def test_an_operation_id_of_a_demand_that_has_no_answer_yet_is_refused(bare: Path) -> None:
    gate = Gate()
    with rig.running(bare) as generator:
        generator.submit(goal(0), "op-0", gate)
        assert gate.reached.wait(rig.PATIENCE_S)
        first, again = generator.submit(goal(1), "op-1"), generator.submit(goal(2), "op-1")
        assert again.journaled.result(rig.PATIENCE_S) is False
        assert "'op-1' is the operation id of another demand" in str(again.future.exception())
        gate.open.set()
        rig.receipt(first)
    assert rig.operations(bare) == ["op-0", "op-1"]


def test_a_bug_in_the_journal_leaves_no_demand_without_an_answer(
    bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with rig.running(bare) as generator:
        monkeypatch.setattr(JournalEntry, "record", lambda entry: {"goal": object()})
        broken = [generator.submit(goal(number)) for number in (1, 2)]
        for ticket in broken:
            assert "internal error" in str(ticket.future.exception(rig.PATIENCE_S))
        monkeypatch.undo()
        assert rig.book(generator, goal(1))[0].outcome == "booked"


def test_a_goal_that_is_nested_deeper_than_a_journal_line_can_be_is_refused(bare: Path) -> None:
    deep: Any = "x"
    for _ in range(101):
        deep = [deep]
    with rig.running(bare) as generator:
        ticket = generator.submit({"id": deep})
        assert "nested more than 100 deep" in str(ticket.future.exception(rig.PATIENCE_S))
        assert rig.book(generator, goal(1))[0].outcome == "booked"


# ---- a disk that is full ----


def test_a_journal_that_cannot_be_written_fails_the_demand_and_works_again_later(
    bare: Path,
) -> None:
    with rig.running(bare) as generator:
        with files_end_at(10):
            ticket = generator.submit(goal(1))
            with pytest.raises(
                StateRepoError, match=r"outbox\.jsonl cannot be written: File too large; check"
            ):
                rig.receipt(ticket)
        rig.book(generator, goal(2))
    assert rig.books(bare) == rig.books_after([goal(2)])


def test_nobody_is_answered_after_a_journal_may_hold_what_it_refused(bare: Path) -> None:
    runtime = Runtime()
    ended = threading.Event()
    runtime.when_unsound = ended.set
    with rig.running(bare, runtime=runtime) as generator:
        journal = generator._slot.journal
        file, journal._file = journal._file, Path("/dev/full").open("ab", buffering=0)  # noqa: SIM115
        ticket = generator.submit(goal(1))
        with pytest.raises(Unsound, match=r"cannot be written or truncated"):
            rig.receipt(ticket)
        assert ended.wait(rig.PATIENCE_S)
        assert isinstance(runtime.unsound, Unsound)
        with pytest.raises(ShuttingDown):
            rig.receipt(generator.submit(goal(2)))
        file.close()
    assert rig.operations(bare) == []


# ---- what was promised holds after a crash ----


@pytest.mark.synced
def test_a_withdrawn_demand_stays_withdrawn_after_a_crash(
    drivers: Drivers, address: str, bare: Path
) -> None:
    """The kill comes when both demands are in the journal and the second is withdrawn."""
    lanes = [[demand("first", goal(1))], [demand("second", goal(2)) | {"withdraw": True}]]
    told = drivers.start(
        address, lanes, opening=demand("opening", goal(0)), die_at="withdrawn"
    ).listen()
    assert told.finished is None
    assert told.withdrawn == ["second"]
    assert rig.restart(address) is True
    assert sorted(rig.operations(bare)) == ["op-first", "op-opening"]
    rig.assert_sound(bare)
