"""The order in which the generator takes the queued demands of many requesters."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest
from demandops.base.errors import QueueFull
from demandops.base.runtime import REAL
from demandops.model.demand import goals
from demandops.serve.demands import Demands, FairQueue, Remote
from demandops.serve.journal import Journal, Ticket

from tests.kit.memory import NOW


def ticket(text: str) -> Ticket:
    """Return the ticket of a demand: its name, which begins with its requester, and its subjects.

    The demand ``all`` may touch anything.
    """
    name, *subjects = text.split()
    if name == "all":
        return Ticket(name, goals.decommission("vehicle01", frozenset(), "", ""), NOW)
    applications = [{"id": subject} for subject in subjects]
    goal = {"kind": "Demand", "demand": name, "requesters": [name[0]]}
    return Ticket(name, goals.read_goal(goal | {"applications": applications}), NOW)


def reference(name: str, subject: str, *who: str) -> Ticket:
    connection = {"id": subject, "requester_ids": list(who)}
    return Ticket(name, goals.read_goal({"id": name, "connections": [connection]}), NOW)


def order(*tickets: Ticket, in_order: bool = False) -> list[str]:
    queue = FairQueue(in_order=in_order)
    for each in tickets:
        queue.append(each)
    return [queue.popleft().operation for _ in tickets]


def test_requesters_take_turns() -> None:
    many = [ticket(f"a{number} x{number}") for number in range(100)]
    assert order(*many, ticket("b0 y"), ticket("c0 z"))[:5] == ["a0", "b0", "c0", "a1", "a2"]


def test_what_must_keep_its_order_keeps_it() -> None:
    shared = (reference("a0", "x", "a"), reference("a1", "y", "a", "b"), reference("b0", "y", "b"))
    assert order(*shared) == ["a0", "a1", "b0"], "the last two goals share a connection"
    apart = (*shared[:2], reference("b0", "z", "b"))
    assert order(*apart) == ["a0", "b0", "a1"], "a common requester orders nothing"
    of_one_client = map(ticket, ("a0 x", "a1 y", "b0 z"))
    assert order(*of_one_client, in_order=True) == ["a0", "a1", "b0"]


@pytest.mark.parametrize(
    ("came", "is_served", "left"),
    [
        ("a0 x0, a1 x1, a2 x2, a3 x3, b0 y", False, "b0 a1 c0 a2 a3"),
        # who had a turn comes after who came meanwhile
        ("a0 x0, a1 x1, a2 x2, b0 y", True, "b0 c0 a1 a2"),
    ],
)
def test_what_was_put_back_comes_first_and_requesters_take_turns_again(
    came: str, is_served: bool, left: str
) -> None:
    queue = FairQueue()
    for each in came.split(", "):
        queue.append(ticket(each))
    taken = [queue.popleft() for _ in range(4)]
    assert [each.operation for each in taken] == ["a0", "b0", "a1", "a2"]
    queue.append(ticket("c0 z"))
    queue.put_back(taken[1:], served=taken[: int(is_served)])
    assert [queue.popleft().operation for _ in range(len(queue))] == left.split()


@pytest.mark.parametrize("seed", range(20))
def test_every_demand_comes_once_and_in_the_order_of_its_subjects(seed: int) -> None:
    random = Random(seed)
    queue, waiting, left = FairQueue(), list[Ticket](), list[Ticket]()
    sent = []
    for number in range(80):
        words = [f"{random.choice('abc')}{number}", *random.sample("uvwxyz", random.randrange(3))]
        sent.append(ticket(" ".join(words) if random.random() < 0.9 else "all"))
    for each in sent:
        queue.append(each)
        waiting.append(each)
        if random.random() < 0.1:
            gone = waiting.pop(random.randrange(len(waiting)))
            queue.remove([gone])
        while waiting and random.random() < 0.3:
            left.append(queue.popleft())
            waiting.remove(left[-1])
        if left and random.random() < 0.1:
            count = random.randrange(min(3, len(left)))
            left, back = left[: len(left) - count], left[len(left) - count :]
            queue.put_back(back)
            waiting += back
            assert len(queue) == len(waiting)
    while waiting:
        left.append(queue.popleft())
        waiting.remove(left[-1])
    assert len(queue) == 0 and len(set(left)) == len(left)
    for number, later in enumerate(left):
        for earlier in left[:number]:
            one, other = earlier.demand.touches(), later.demand.touches()
            is_free = one is not None and other is not None and one.isdisjoint(other)
            assert is_free or sent.index(earlier) < sent.index(later)


@pytest.mark.parametrize(
    ("limit", "away", "told"),
    [
        (10, "", "1 demands without a requester have no answer yet; send"),
        (1, "", "1 demands are queued already; send"),
        (1, "503", r"1 demands are queued already and cannot be published \(503\); send"),
    ],
)
def test_too_many_demands_are_told_with_the_reason(
    tmp_path: Path, limit: int, away: str, told: str
) -> None:
    remote = Remote("", REAL)
    remote.unreachable = away
    demands = Demands(Journal(tmp_path / "journal"), limit, 1, remote, REAL)
    tickets = [Ticket(name, goals.read_goal({}), REAL.now()) for name in ("a", "b")]
    for ticket in tickets:
        demands.arrive(ticket)
    demands.take([], 0)
    with pytest.raises(QueueFull, match=f"^{told}"):
        tickets[1].future.result(0)
