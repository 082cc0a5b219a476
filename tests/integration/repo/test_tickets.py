"""The generator's promises to a caller of `submit` hold whatever the caller does."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import (
    DemandOpsError,
    QueueFull,
    StateRepoError,
    Unsound,
)
from demandops.base.runtime import Runtime
from demandops.serve.generator import Generator
from demandops.serve.journal import Ticket

from tests.kit import rig
from tests.kit.clock import Clock
from tests.kit.goals import put
from tests.kit.limits import files_end_at
from tests.kit.rig import goal

# ---- withdrawals ----


@pytest.mark.parametrize(
    ("stage", "outcome"),
    [
        ("admitted", "Withdrawn"),
        ("booked", "Withdrawn"),
        ("committed", "booked"),
        ("pushed", "booked"),
    ],
)
def test_a_demand_can_be_taken_back_until_it_is_committed(
    address: str, bare: Path, stage: str, outcome: str
) -> None:
    answers: list[bool] = []
    with rig.running(address) as generator:

        def take_back(told: str, text: str) -> None:
            if told == stage:
                answers.append(generator.withdraw("op-1"))

        assert rig.outcome(generator.submit(goal(1), "op-1", take_back)) == outcome
        assert answers == [outcome == "Withdrawn"]
        assert generator.withdraw("op-1") is generator.withdraw("never-known") is False
        rig.book(generator, goal(2))
    booked = [goal(1)] if outcome == "booked" else []
    assert rig.books(bare) == rig.books_after([*booked, goal(2)])


# ---- closing ----


def test_closing_finishes_what_is_in_hand_however_often_it_is_asked(
    address: str, bare: Path
) -> None:
    generator = Generator(address)
    with rig.busy(generator, goal(0), "op-0") as first:
        tickets = [first, *(generator.submit(goal(n), f"op-{n}") for n in range(1, 10))]
        stopped = [generator.stop(rig.PATIENCE_S), generator.stop(0)]
    assert [one.result(rig.PATIENCE_S) for one in stopped] == [True, True]
    assert all(ticket.future.done() for ticket in tickets)
    assert rig.operations(bare) == [f"op-{n}" for n in range(10)]
    late = generator.submit(goal(1))
    assert (rig.outcome(late), late.journaled.result()) == ("ShuttingDown", False)
    assert generator.close(rig.PATIENCE_S) is True


def test_a_demand_handed_in_while_closing_is_answered_or_not_taken(bare: Path) -> None:
    for _ in range(5):
        generator = Generator(str(bare))
        tickets: list[Ticket] = []

        def hand_in(generator: Generator = generator, tickets: list[Ticket] = tickets) -> None:
            while not (tickets and tickets[-1].future.done() and tickets[-1].future.exception()):
                tickets.append(generator.submit(goal(len(tickets) % 20)))

        thread = threading.Thread(target=hand_in, daemon=True)
        thread.start()
        rig.wait_until(tickets.__len__, "the first demand is submitted")
        assert generator.close(rig.PATIENCE_S) is True
        thread.join(rig.PATIENCE_S)
        assert all(ticket.future.done() for ticket in tickets)
        assert rig.outcome(tickets[-1]) == "ShuttingDown"


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


# ---- limits ----


def test_a_full_queue_takes_no_more_and_takes_again_when_there_is_room(bare: Path) -> None:
    with rig.running(bare, queue_limit=3) as generator:
        with rig.busy(generator, goal(0)):
            waiting = [generator.submit(goal(n)) for n in (1, 2, 3)]
            rig.wait_until_queued(waiting)  # although another is being evaluated
            assert rig.outcome(generator.submit(goal(4))) == "QueueFull"
        assert [rig.outcome(ticket) for ticket in waiting] == ["booked"] * 3
        rig.book(generator, goal(4))


def test_a_requester_may_have_only_so_many_demands_waiting(bare: Path) -> None:
    with rig.running(bare, requester_limit=2) as generator:
        with rig.busy(generator, goal(1)):
            second = generator.submit(goal(1), "again")
            with pytest.raises(QueueFull, match=r"^2 demands of 'user1' .* requester_queue_limit$"):
                rig.receipt(generator.submit(goal(1), "op-3"))
            other = generator.submit(goal(2))
        assert (rig.outcome(second), rig.outcome(other)) == ("unchanged", "booked")
        rig.book(generator, goal(1))


def test_a_demand_waits_for_few_slow_ones_of_another_requester(bare: Path) -> None:
    clock = Clock()
    begun, begun_before = list[str](), list[int]()

    def slow(stage: str, text: str) -> None:
        if stage == "admitted":
            begun.append(text)
            clock.pass_(0.6)

    def quick(stage: str, text: str) -> None:
        if stage == "pushed":
            begun_before.append(len(begun))

    with rig.running(bare, runtime=clock) as generator:
        with rig.busy(generator, put("first")):
            tickets = [
                generator.submit(put(f"slow{n}", "station00"), listener=slow) for n in range(12)
            ]
            tickets += [
                generator.submit(put(name, name), listener=quick)
                for name in ("vehicle01", "vehicle02")
            ]
        assert {rig.outcome(ticket) for ticket in tickets} == {"booked"}
    assert len(begun) == 12
    assert max(begun_before) <= 3


# ---- callers that misbehave stop nobody else ----


def cancel(generator: Generator) -> None:
    """Cancel futures, as `asyncio.wait_for(asyncio.wrap_future(ticket.future), …)` may."""
    with rig.busy(generator, goal(1)) as first:
        second = generator.submit(goal(2))
        first.future.cancel()
        second.future.cancel()


def fail_in_a_listener(generator: Generator) -> None:
    def fail(stage: str, text: str) -> None:
        raise RuntimeError(stage)

    assert rig.outcome(generator.submit(goal(1), listener=fail)) == "booked"


def submit_in_a_done_callback(generator: Generator) -> None:
    done = threading.Event()

    def then(future: Any) -> None:
        generator.submit(goal(2)).future.add_done_callback(lambda _: done.set())

    generator.submit(goal(1)).future.add_done_callback(then)
    assert done.wait(rig.PATIENCE_S)


def send_what_is_no_plain_data(generator: Generator) -> None:
    deep: Any = "x"
    for _ in range(101):  # deeper than a line of the journal can be
        deep = [deep]
    odd = [goal(1) | {"id": b"bytes"}, goal(1) | {"apps": {1, 2}}, {**goal(1), ("a", "b"): 1}]
    for made in (*odd, {"id": deep}, object(), None, float("nan"), "a text"):
        with pytest.raises(DemandOpsError):
            rig.receipt(generator.submit(made))


def send_two_with_one_operation_id(generator: Generator) -> None:
    with rig.busy(generator, goal(0), "op-0"):
        first, again = generator.submit(goal(1), "op-1"), generator.submit(goal(2), "op-1")
        assert again.journaled.result(rig.PATIENCE_S) is False
        assert "'op-1' is the operation id of another demand" in str(again.future.exception())
    assert rig.outcome(first) == "booked"


def forge_a_trailer_by_an_operation_id(generator: Generator) -> None:
    with pytest.raises(ValueError, match="is not an operation id"):
        generator.submit(goal(1), "op-1\nRequester: somebody else")


def send_what_the_journal_cannot_write(generator: Generator) -> None:
    with pytest.MonkeyPatch.context() as patch:  # a bug
        patch.setattr(Ticket, "as_data", lambda ticket: {"goal": object()})
        for ticket in [generator.submit(goal(number)) for number in (1, 2)]:
            assert "internal error" in str(ticket.future.exception(rig.PATIENCE_S))
    with files_end_at(10), pytest.raises(StateRepoError, match=r"outbox\.jsonl cannot be written"):
        rig.receipt(generator.submit(goal(1)))


@pytest.mark.parametrize(
    "misbehave",
    [
        cancel,
        fail_in_a_listener,
        submit_in_a_done_callback,
        send_what_is_no_plain_data,
        send_two_with_one_operation_id,
        forge_a_trailer_by_an_operation_id,
        send_what_the_journal_cannot_write,
    ],
)
def test_who_misbehaves_stops_nobody_else(
    bare: Path, misbehave: Callable[[Generator], None]
) -> None:
    with rig.running(bare) as generator:
        misbehave(generator)
        rig.book(generator, goal(3))
    assert rig.restart(bare) is True
    rig.assert_sound(bare)


# ---- a disk that is full ----


def test_nobody_is_answered_after_a_journal_may_hold_what_it_refused(bare: Path) -> None:
    runtime = Runtime()
    ended = threading.Event()
    runtime.when_unsound = ended.set
    with rig.running(bare, runtime=runtime) as generator:
        journal = generator._journal
        file, journal._file = journal._file, Path("/dev/full").open("ab", buffering=0)  # noqa: SIM115
        assert rig.outcome(generator.submit(goal(1))) == "Unsound"
        assert ended.wait(rig.PATIENCE_S)
        assert isinstance(runtime.unsound, Unsound)
        assert rig.outcome(generator.submit(goal(2))) == "ShuttingDown"
        file.close()
    assert rig.operations(bare) == []
