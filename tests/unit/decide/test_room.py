"""Files of waiting demands, and what leaves a drained node; ``tests/scenarios`` has more."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import yaml
from demandops.decide.booking import Drain
from demandops.decide.placement.relocation import with_moves
from demandops.model.demand.demand import Requirement
from demandops.model.demand.goals import read_goal
from demandops.model.ledger import records
from demandops.model.ledger.records import WaitingDemand

from tests.kit import plain_yaml
from tests.kit.config import state_of
from tests.kit.goals import put
from tests.kit.memory import NOW, MemoryRepo, rebuilt


@pytest.mark.parametrize("change", plain_yaml.beside(__file__), ids=str)
def test_a_file_that_a_person_broke_holds_nothing(change: dict[str, Any]) -> None:
    waiting = WaitingDemand(read_goal(put("a")), NOW)
    path, text = records.waiting_path("a"), records.waiting_text(waiting)
    assert records.read_waiting(text, path) == waiting
    broken = yaml.safe_dump(yaml.safe_load(text) | change)
    assert records.read_waiting(broken, path) is None


# ---- what leaves a drained node ----

FREE = ("edge", "vehicle01")  # the nodes with a GPU, beside the drained node `cloud`


def on_cloud(count: int, *stuck: int) -> MemoryRepo:
    """Return a repo with applications on the drained node ``cloud``; the ``stuck`` must stay."""
    repo = MemoryRepo()
    for number in range(count):
        app = {
            "id": f"app{number}",
            "type": "object-detection-fusion",
            "place": {"labels": ["node_id=cloud"]},
            "inputs": {"ego_data": [{"topic": "/ego", "source": "cloud"}]},
        }
        goal = {"kind": "Demand", "demand": f"d{number}", "requesters": ["v"]}
        repo.send(goal | {"applications": [app]})
    gpu = Requirement(capabilities=("gpu",))
    ledger = rebuilt(
        one
        if one.subject.id in [f"app{number}" for number in stuck]
        else replace(one, held=replace(one.application, place=gpu))
        for one in repo.state.ledger
    )
    nodes = {
        id: node.model_copy(
            update={"capabilities": ("gpu",) * (id in FREE), "drained": id == "cloud"}
        )
        for id, node in repo.config.nodes.items()
    }
    repo.state = state_of(replace(repo.config, nodes=nodes), ledger)
    return repo


def test_what_leaves_a_node_is_spread_over_the_others() -> None:
    decision = on_cloud(4).decide(Drain(id="cloud"))
    assert len(decision.placed) == 4
    assert dict(decision.state.ledger.applications_on) == dict.fromkeys(FREE, 2)


def test_a_drain_in_parts_moves_the_same_applications_and_skips_none() -> None:
    state = on_cloud(5, 0, 3).state
    whole = with_moves(Drain(id="cloud"), state, state.usage(), state.names())
    assert len(whole.moved) == 3 and len(whole.stays) == 2 and not whole.last
    parts = [with_moves(Drain(id="cloud"), state, state.usage(), state.names(), most=2)]
    while after := parts[-1].last:
        drain = Drain(id="cloud", after=after)
        parts.append(with_moves(drain, state, state.usage(), state.names(), most=2))
    assert len(parts) > 1
    stays = [text.split(",")[0] for part in parts for text in part.stays]
    assert stays == [text.split(",")[0] for text in whole.stays]
    assert sum(len(part.moved) for part in parts) == 3
