"""What ends the waiting of a demand; ``test_capacity`` has who waits, and in which order."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import pytest
import yaml
from demandops.decide.booking import Restoration
from demandops.model.ledger import records
from demandops.model.ledger.records import in_turn

from tests.kit.memory import MemoryRepo
from tests.unit.decide.test_capacity import book_waiting, recorders


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
