"""Demands that leave out their broker, or whose requesters have similar names, are booked."""

from __future__ import annotations

import re
from itertools import combinations
from typing import Any

import pytest

from tests.kit import plain_yaml
from tests.kit.config import brokers
from tests.kit.goals import application, connection, goal
from tests.kit.memory import MemoryRepo

CASES = plain_yaml.beside(__file__)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_the_broker_is_chosen_by_rule_and_told_if_it_is_not_the_requested_one(
    case: dict[str, Any],
) -> None:
    asked, chosen, ends = case["asked"], case["chosen"], ("vehicle00", case["to"])
    books = MemoryRepo(brokers(*case["there"]))
    decision = books.send(goal([], [connection(broker=asked, ends=ends)]))
    texts = " ".join(books.rendered().values())
    assert {*re.findall(r"\bbroker-(\w+)", texts)} == {chosen}
    told = (
        f"'vehicle00/edge' uses the broker on '{chosen}', because inventory/brokers.yaml has none"
    )
    warned = [f"{told} on '{asked}'" in one for one in decision.warnings]
    assert warned == [True] * (asked not in ("", chosen))
    again = books.send(goal([], [connection(broker=chosen, ends=ends)], id="2"))
    assert again.outcome == "booked", "both goals must get the same broker"


def test_every_pair_of_odd_requesters_makes_its_own_demand() -> None:
    texts = ["a", "a,b", "b", "a b", '["a"]', "a\\", "\\a", '"']
    books = MemoryRepo()
    for pair in combinations(texts, 2):
        books.send(goal([application(who=pair)]))
    demands = {claim.demand for claim in books.state.ledger}
    assert len(demands) == len(list(combinations(texts, 2)))
