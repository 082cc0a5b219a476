"""Demands that leave out their broker, or whose requesters have similar names, are booked."""

from __future__ import annotations

from itertools import combinations

import pytest
import yaml

from tests.kit.config import brokers
from tests.kit.goals import application, connection, goal
from tests.kit.memory import MemoryRepo


def hosts(books: MemoryRepo) -> set[str]:
    return {
        yaml.safe_load(config["data"]["params.yaml"])["/**/*"]["ros__parameters"]["broker"]["host"]
        for config in books.objects("ConfigMap").values()
    }


@pytest.mark.parametrize(
    ("there", "requested", "ends", "chosen"),
    [
        (("cloud", "edge", "vehicle00"), "cloud", ("vehicle00", "edge"), "cloud"),
        (("edge",), "edge", ("vehicle00", "cloud"), "edge"),
        (("cloud", "edge", "vehicle00"), "", ("vehicle00", "edge"), "edge"),
        (("cloud", "vehicle00"), "", ("vehicle00", "edge"), "vehicle00"),
        (("cloud",), "", ("vehicle00", "edge"), "cloud"),
        (("cloud",), "edge", ("vehicle00", "edge"), "cloud"),
        (("cloud", "edge"), "nowhere", ("vehicle00", "edge"), "edge"),
        (("cloud", "vehicle00"), "station00", ("vehicle00", "edge"), "vehicle00"),
    ],
    ids=["the requested", "the requested, which is the only one", "the target's",
         "the source's", "the only one", "the only one instead of the requested",
         "the target's instead of one that is not there",
         "the source's instead of one that is not there"],
)  # fmt: skip
def test_the_broker_is_chosen_by_rule_and_told_if_it_is_not_the_requested_one(
    there: tuple[str, ...], requested: str, ends: tuple[str, str], chosen: str
) -> None:
    books = MemoryRepo(brokers(*there))
    decision = books.send(goal([], [connection(broker=requested, ends=ends)]))
    assert hosts(books) == {f"broker-{chosen}"}
    told = (
        f"'vehicle00/edge' uses the broker on '{chosen}', because inventory/brokers.yaml has none"
    )
    assert [f"{told} on '{requested}'" in one for one in decision.warnings] == [True] * (
        requested not in ("", chosen)
    )
    again = books.send(goal([], [connection(broker=chosen, ends=ends)], id="2"))
    assert again.outcome == "booked", "both goals must get the same broker"


def test_a_broker_left_open_and_one_named_for_one_connection_agree() -> None:
    books = MemoryRepo(brokers("cloud", "edge"))
    books.send(goal([], [connection(broker="")], id="1"))
    assert books.send(goal([], [connection(broker="cloud")], id="2")).outcome == "booked"
    assert hosts(books) == {"broker-cloud"}
    books.send(goal([], [connection(broker="cloud")], id="2", shutdown=True))
    assert hosts(books) == {"broker-edge"}


def test_every_pair_of_odd_requesters_makes_its_own_demand() -> None:
    texts = ["a", "a,b", "b", "a b", '["a"]', "a\\", "\\a", '"']
    books = MemoryRepo()
    for pair in combinations(texts, 2):
        books.send(goal([application(who=pair)]))
    demands = {claim.demand for claim in books.state.ledger}
    assert len(demands) == len(list(combinations(texts, 2)))
