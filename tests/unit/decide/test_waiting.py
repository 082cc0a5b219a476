"""Waiting demands are booked in the order in which they wait, and no demand waits if it fits."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from random import Random
from typing import Any

import pytest
import yaml
from demandops.decide.decision import Decision
from demandops.decide.restoration import Restoration
from demandops.model.demand.demand_request import Decommission
from demandops.model.ledger import records
from demandops.model.ledger.records import in_turn
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples
from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo, ledger_in
from tests.unit.decide.test_capacity import CAPACITY, recorders, used


def waiting_repo() -> MemoryRepo:
    """Return a repo whose only access domain lets demands wait."""
    state = recorders()
    (domain,) = state.config.domains.values()
    domain = domain.model_copy(update={"when_full": "wait"})
    config = replace(
        state.config,
        domains={domain.name: domain},
        domain_of=dict.fromkeys(state.config.domain_of, domain),
    )
    return MemoryRepo(state=state_of(config, state.ledger))


def put(name: str, topics: int = 1, **more: Any) -> dict[str, Any]:
    """Return a demand for a recorder, which has one replica for every two topics."""
    cloud = [{"topic": f"/{name}/t{number}", "source": "vehicle01"} for number in range(topics)]
    app = {"id": name, "type": "recorder", "place": {"role": "edge"}}
    app |= {"inputs": {"point_cloud": cloud}}
    head = {"kind": "Demand", "demand": name, "requesters": ["v"], "applications": [app]}
    return head | {"connections": []} | more


def release(name: str) -> dict[str, Any]:
    return {"kind": "Demand", "operation": "release", "demand": name, "requesters": ["v"]}


def book_waiting(repo: MemoryRepo) -> list[str]:
    """Try to book each waiting demand in order; return the ids of those that were booked."""
    booked = []
    for one in in_turn(repo.state.ledger.waiting):
        taken = repo.take(dict(one.goal))
        assert isinstance(taken, Decision)
        booked += [one.demand] if taken.outcome == "booked" else []
    return booked


def waits(repo: MemoryRepo) -> list[str]:
    return [one.demand for one in in_turn(repo.state.ledger.waiting)]


@examples(8)
@given(chances, st.integers(4, 14))
def test_what_waits_does_not_fit_and_is_booked_in_turn(random: Random, length: int) -> None:
    repo, sent = waiting_repo(), dict[str, dict[str, Any]]()
    for _ in range(length):
        repo.now += timedelta(minutes=1)
        name = f"d{random.randrange(6)}"
        held = bool(repo.state.ledger.claims_of_demand(name))
        if held or (name in waits(repo) and random.random() < 0.5):
            taken = repo.take(release(name))
        else:
            more = {"priority": random.randrange(2)}
            sent[name] = put(name, random.choice((1, 3, 5)), **more)
            taken = repo.take(sent[name])
        assert isinstance(taken, Decision)
        if taken.frees:
            book_waiting(repo)
        for one in in_turn(repo.state.ledger.waiting):
            assert one.goal == sent[one.demand]
            assert not repo.state.ledger.claims_of_demand(one.demand)
            assert repo.decide(dict(one.goal)).outcome == "waiting"
        turns = [(-one.priority, one.since) for one in in_turn(repo.state.ledger.waiting)]
        assert turns == sorted(turns)
        assert all(used(repo)[id] <= most for id, most in CAPACITY.items())
        assert ledger_in(repo.files) == repo.state.ledger


def full_repo() -> MemoryRepo:
    """Return a repo whose edges are full and in which two demands wait."""
    repo = waiting_repo()
    for number, topics in enumerate((5, 5, 3)):
        repo.send(put(f"full{number}", topics))
    for name, who in (("a", "v"), ("b", "w")):
        taken = repo.send(put(name) | {"requesters": [who]})
        assert taken.outcome == "waiting" and taken.lease_s is None
    return repo


def test_a_decommissioned_requester_waits_no_longer() -> None:
    repo = full_repo()
    decision = repo.send(Decommission("w", kinds=frozenset({"requester"})))
    assert (decision.outcome, waits(repo)) == ("released", ["a"])
    assert records.waiting_path("b") not in repo.files


def test_a_rollback_leaves_what_waits() -> None:
    repo = full_repo()
    before = repo.state.ledger
    repo.send(release("full0"))
    assert book_waiting(repo) == ["a", "b"]
    repo.send(Restoration("back", claims=tuple(before), drop_newer=True, to="0" * 40))
    assert waits(repo) == []
    assert repo.state.ledger.claims == before.claims
    repo = full_repo()
    repo.send(Restoration("back", claims=(), drop_newer=True, to="0" * 40))
    assert waits(repo) == ["a", "b"]
    assert book_waiting(repo) == ["a", "b"]


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "Other"},
        {"since": "soon"},
        {"requesters": []},
        {"demand": "x"},
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
