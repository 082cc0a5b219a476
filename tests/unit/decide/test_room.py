"""What nodes have room for, and what ends the waiting of a demand; ``tests/scenarios`` has more."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from functools import cache
from typing import Any

import pytest
import yaml
from demandops.decide.booking import Drain, Restoration
from demandops.decide.decision import Decision
from demandops.decide.placement.relocation import with_moves
from demandops.decide.state import State
from demandops.model.config.load import load
from demandops.model.demand.demand import Requirement
from demandops.model.ledger import records
from demandops.model.ledger.records import in_turn

from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo, rebuilt
from tests.scenarios.running import configuration

VEHICLES = ("vehicle00", "vehicle01")
CAPACITY = {"west": 5, "east": 3, "vehicle00": 2}
"""The capacity of some nodes, in cpus; other nodes have no limit."""


@cache
def recorders(when_full: str = "refuse") -> State:
    """Return a state in which each driver and each replica of a recorder requests 1 cpu."""
    nodes = [
        {"id": id, "type": "vehicle" if id in VEHICLES else "edge", "cluster": "c-its"}
        | ({"capacity": {"cpu": CAPACITY[id]}} if id in CAPACITY else {})
        for id in (*VEHICLES, "west", "east")
    ]
    requests = {"cpu": 1}
    domain = {"name": "all", "namespace": "all", "whenFull": when_full}
    files = configuration(
        ("recorder",),
        {
            "appdefs/recorder/appdef.yaml": {"services": {"recorder": {"requests": requests}}},
            "appdefs/driver/service.yaml": {"requests": requests},
            "inventory/nodes.yaml": {"nodes": nodes},
            "inventory/brokers.yaml": {"brokers": [{"node": "west", "host": "broker"}]},
            "policy/access-domains.yaml": {"domains": [domain]},
        },
    )
    return state_of(load(files))


def book_waiting(repo: MemoryRepo) -> list[str]:
    """Try to book each waiting demand in order; return the ids of those that were booked."""
    booked = []
    for one in in_turn(repo.state.ledger.waiting):
        taken = repo.take(one.put)
        assert isinstance(taken, Decision)
        booked += [one.demand] if taken.outcome == "booked" else []
    return booked


def waiting_repo() -> MemoryRepo:
    """Return a repo whose only access domain lets demands wait."""
    return MemoryRepo(state=recorders("wait"))


def put(name: str, topics: int = 1, **more: Any) -> dict[str, Any]:
    """Return a demand for a recorder, which has one replica for every two topics."""
    cloud = [{"topic": f"/{name}/t{number}", "source": "vehicle01"} for number in range(topics)]
    app = {"id": name, "type": "recorder", "place": {"role": "edge"}}
    app |= {"inputs": {"point_cloud": cloud}}
    head = {"kind": "Demand", "demand": name, "requesters": ["v"], "applications": [app]}
    return head | {"connections": []} | more


def release(name: str) -> dict[str, Any]:
    return {"kind": "Demand", "operation": "release", "demand": name, "requesters": ["v"]}


def waits(repo: MemoryRepo) -> list[str]:
    return [one.demand for one in in_turn(repo.state.ledger.waiting)]


def full_repo() -> MemoryRepo:
    """Return a repo whose edges are full and in which two demands wait."""
    repo = waiting_repo()
    for number, topics in enumerate((5, 5, 3)):
        repo.send(put(f"full{number}", topics))
        repo.now += timedelta(minutes=1)
    for name, who in (("a", "v"), ("b", "w")):
        taken = repo.send(put(name) | {"requesters": [who]})
        assert taken.outcome == "waiting" and taken.lease_s is None
    return repo


def test_the_bookkeeping_has_what_is_requested_of_nodes_with_a_capacity() -> None:
    repo = MemoryRepo(state=recorders())
    cloud = {"point_cloud": [{"topic": "/t", "source": "vehicle01"}]}
    app = {"id": "a", "type": "recorder", "node": "east", "inputs": cloud}
    repo.send({"kind": "Demand", "demand": "d", "requesters": ["v"], "applications": [app]})
    assert repo.bookkeeping()["nodes"] == {
        "east": {"cpu": {"requested": "1", "capacity": "3"}},
        "vehicle00": {"cpu": {"requested": "0", "capacity": "2"}},
        "west": {"cpu": {"requested": "0", "capacity": "5"}},
    }
    assert "nodes" not in MemoryRepo().bookkeeping()


def test_a_rollback_leaves_what_waits() -> None:
    repo = full_repo()
    before = repo.state.ledger
    repo.send(release("full0"))
    assert book_waiting(repo) == ["a", "b"]
    repo.send(Restoration(id="back", claims=tuple(before), drop_newer=True, to="0" * 40))
    assert waits(repo) == []
    assert repo.state.ledger.claims == before.claims
    repo = full_repo()
    repo.send(Restoration(id="back", claims=(), drop_newer=True, to="0" * 40))
    assert waits(repo) == ["a", "b"]
    assert book_waiting(repo) == ["a", "b"]


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "Other"},
        {"since": "soon"},
        {"x": 1},
        {"goal": {"id": "a", "apps": []}},
        {"goal": {"kind": "Demand", "demand": "b", "requesters": ["v"]}},
        {"goal": {"kind": "Demand", "operation": "release", "demand": "a", "requesters": ["v"]}},
    ],
)
def test_a_file_that_a_person_broke_holds_nothing(change: dict[str, Any]) -> None:
    repo = full_repo()
    path = records.waiting_path("a")
    assert records.read_waiting(repo.files[path], path) == repo.state.ledger.waiting["a"]
    broken = yaml.safe_dump(yaml.safe_load(repo.files[path]) | change)
    assert records.read_waiting(broken, path) is None


# ---- what leaves a drained node ----

FREE = ("edge", "vehicle01")
"""The nodes with a GPU, beside the drained node ``cloud``."""


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
