"""Files of waiting demands, and what leaves a drained node; ``tests/scenarios`` has more."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from demandops.decide.booking import Drain
from demandops.decide.placement.relocation import with_moves
from demandops.model.demand.goals import read_goal
from demandops.model.ledger import records
from demandops.model.ledger.records import WaitingDemand
from demandops.views.kinds import KINDS
from rpds import HashTrieMap

from tests.kit import plain_yaml
from tests.kit.connections import state
from tests.kit.goals import put
from tests.kit.memory import NOW, MemoryRepo


@pytest.mark.parametrize("change", plain_yaml.beside(__file__), ids=str)
def test_a_file_that_a_person_broke_holds_nothing(change: dict[str, Any]) -> None:
    waiting = WaitingDemand(read_goal(put("a")), NOW)
    path, text = records.waiting_path("a"), records.waiting_text(waiting)
    assert records.read_waiting(text, path) == waiting
    broken = yaml.safe_dump(yaml.safe_load(text) | change)
    assert records.read_waiting(broken, path) is None


# ---- what leaves a drained node ----

GPU = {"capabilities": ["gpu"]}


def on_cloud(count: int, *stuck: int) -> MemoryRepo:
    """Return a repo with applications on the drained node ``cloud``; the ``stuck`` must stay.

    The others may run on each other node with a GPU, which are ``edge`` and ``vehicle01``.
    """
    repo = MemoryRepo(state=state(cloud=GPU))
    for number in range(count):
        goal = put(f"d{number}", id=f"app{number}", topic=("/ego", "cloud"), node="")
        place = {"labels": ["node_id=cloud"]} if number in stuck else GPU
        goal["applications"][0]["place"] = place
        repo.send(goal)
    drained = state(cloud=GPU | {"drained": True}, edge=GPU, vehicle01=GPU)
    repo.state = replace(drained, ledger=repo.state.ledger)
    return repo


def test_what_leaves_a_node_is_spread_over_the_others() -> None:
    decision = on_cloud(4).decide(Drain(id="cloud"))
    assert len(decision.placed) == 4
    assert dict(decision.state.ledger.applications_on) == {"edge": 2, "vehicle01": 2}


def test_a_drain_in_parts_moves_the_same_applications_and_skips_none() -> None:
    there = on_cloud(5, 0, 3).state
    whole = with_moves(Drain(id="cloud"), there, there.usage, there.names)
    assert len(whole.moved) == 3 and len(whole.stays) == 2 and not whole.last
    parts = [with_moves(Drain(id="cloud"), there, there.usage, there.names, most=2)]
    while after := parts[-1].last:
        drain = Drain(id="cloud", after=after)
        parts.append(with_moves(drain, there, there.usage, there.names, most=2))
    assert len(parts) > 1
    stays = [text.split(",")[0] for part in parts for text in part.stays]
    assert stays == [text.split(",")[0] for text in whole.stays]
    assert sum(len(part.moved) for part in parts) == 3


def test_waiting_demands_are_listed_in_their_turn() -> None:
    demands = [
        (read_goal(put(name)), NOW + timedelta(place)) for place, name in enumerate("zyxwvu")
    ]
    given = [WaitingDemand(*each) for each in demands]
    ledger = SimpleNamespace(waiting=HashTrieMap({each.demand: each for each in given}))
    source: Any = SimpleNamespace(claims_of_demands={}, state=SimpleNamespace(ledger=ledger))
    assert [values[0] for _, values in KINDS["demands"].entries(source)] == given
