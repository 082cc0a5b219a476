"""The order in which the generator takes the queued demands of many requesters."""

from __future__ import annotations

from random import Random
from typing import Any

import pytest
from demandops.serve.queue import FairQueue, Ticket, requester_of, subjects_of

from tests.kit.memory import NOW


def ticket(name: str, who: str, *subjects: str, **fields: Any) -> Ticket:
    applications = [{"id": subject} for subject in subjects]
    goal = {"demand": name, "requesters": [who], "applications": applications, **fields}
    return Ticket(name, goal, NOW)


def order(*tickets: Ticket) -> list[str]:
    queue = FairQueue()
    for each in tickets:
        queue.append(each)
    return [queue.popleft().operation for _ in tickets]


def test_requesters_take_turns() -> None:
    many = [ticket(f"a{number}", "a", f"x{number}") for number in range(100)]
    assert order(*many, ticket("b0", "b", "y"), ticket("c0", "c", "z"))[:5] == [
        *("a0", "b0", "c0"),
        *("a1", "a2"),
    ]


def test_the_turn_goes_to_what_a_demand_must_follow() -> None:
    waiting = (
        ticket("a0", "a", "x0"),
        ticket("a1", "a", "x1"),
        ticket("a2", "a", "x2", "shared"),
        ticket("b0", "b", "shared"),
    )
    assert order(*waiting) == ["a0", "a2", "a1", "b0"]


def reference(name: str, subject: str, *who: str) -> Ticket:
    connection = {"id": subject, "requester_ids": list(who)}
    return Ticket(name, {"id": name, "connections": [connection]}, NOW)


def test_goals_of_the_reference_that_share_a_requester_keep_their_order() -> None:
    waiting = (reference("a0", "x", "a"), reference("a1", "y", "a", "b"), reference("b0", "z", "b"))
    assert order(*waiting) == ["a0", "a1", "b0"]


def test_demands_of_one_client_keep_their_order() -> None:
    queue = FairQueue(in_order=True)
    for each in (ticket("a0", "a", "x"), ticket("a1", "a", "y"), ticket("b0", "b", "z")):
        queue.append(each)
    assert [queue.popleft().operation for _ in range(3)] == ["a0", "a1", "b0"]


def test_nothing_overtakes_what_may_touch_anything() -> None:
    everything = Ticket("all", {"kind": "Decommission", "name": "vehicle01"}, NOW)
    waiting = (ticket("a0", "a", "x"), ticket("a1", "a", "y"), everything, ticket("b0", "b", "z"))
    assert order(*waiting) == ["a0", "a1", "all", "b0"]


def test_what_was_put_back_comes_first_and_requesters_take_turns_again() -> None:
    queue = FairQueue()
    for each in (*(ticket(f"a{n}", "a", f"x{n}") for n in range(4)), ticket("b0", "b", "y")):
        queue.append(each)
    taken = [queue.popleft() for _ in range(4)]
    assert [each.operation for each in taken] == ["a0", "b0", "a1", "a2"]
    queue.append(ticket("c0", "c", "z"))
    queue.put_back(taken[1:])
    left = [queue.popleft().operation for _ in range(len(queue))]
    assert left == ["b0", "a1", "c0", "a2", "a3"]


def test_who_had_a_turn_comes_after_who_came_meanwhile() -> None:
    queue = FairQueue()
    for each in (*(ticket(f"a{n}", "a", f"x{n}") for n in range(3)), ticket("b0", "b", "y")):
        queue.append(each)
    taken = [queue.popleft() for _ in range(4)]
    queue.append(ticket("c0", "c", "z"))
    queue.put_back(taken[1:], served=taken[:1])
    left = [queue.popleft().operation for _ in range(len(queue))]
    assert left == ["b0", "c0", "a1", "a2"]


@pytest.mark.parametrize("seed", range(20))
def test_every_demand_comes_once_and_in_the_order_of_its_subjects(seed: int) -> None:
    random = Random(seed)
    queue, waiting, left = FairQueue(), list[Ticket](), list[Ticket]()
    sent = [
        ticket(f"{number}", random.choice("abc"), *random.sample("uvwxyz", random.randrange(3)))
        if random.random() < 0.9
        else Ticket(f"{number}", None, NOW)
        for number in range(80)
    ]
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
            if earlier.goal is None or later.goal is None:
                shared = True
            else:
                shared = bool(
                    set(subjects_of(earlier.goal) or ()) & set(subjects_of(later.goal) or ())
                )
            assert not shared or sent.index(earlier) < sent.index(later)


@pytest.mark.parametrize(
    "goal",
    [
        *(None, 1, "x", [], {}, {"apps": 3}, {"apps": [3, {"header": []}], "connections": [None]}),
        {"apps": [{"object_detection_fusion_app": {"requester_ids": [7]}}], "demand": ["x"]},
    ],
)
def test_an_invalid_goal_is_queued_too(goal: Any) -> None:
    assert requester_of(goal) == ""
    assert not subjects_of(goal)
    assert order(Ticket("one", goal, NOW), Ticket("two", goal, NOW)) == ["one", "two"]
