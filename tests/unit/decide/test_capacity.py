"""Services never use more of a node than it has, and demands that lack only room may wait for it.

Each change updates a node's usage without a recount.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from functools import cache
from random import Random
from typing import Any

import pytest
from demandops.base.errors import Refused
from demandops.base.quantities import amount_of, amount_text
from demandops.decide.checks.forbidden import whole_usage
from demandops.decide.decision import Decision
from demandops.decide.state import State
from demandops.model.config.load import load
from demandops.model.ledger.ledger import ClaimChange
from demandops.model.ledger.records import in_turn
from hypothesis import given

from tests.kit import plain_yaml
from tests.kit.chance import chances, examples
from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo, ledger_in
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


def recorder(random: Random, vehicles: Sequence[str]) -> dict[str, Any]:
    """Return a random recorder application with one replica for every two topics."""
    known = [(vehicle, f"/t{number}") for vehicle in vehicles for number in range(3)]
    topics = random.sample(known, random.randint(1, min(5, len(known))))
    where = random.choice(({"place": {"role": "edge"}}, {"node": "west"}, {"node": "east"}))
    inputs = {"point_cloud": [{"topic": topic, "source": of} for of, topic in topics]}
    return {"id": f"app{random.randrange(4)}", "type": "recorder", "inputs": inputs} | where


def goal(random: Random, *, alone: bool) -> dict[str, Any]:
    """Return a random demand; if ``alone``, it can share nothing that would be new on a full node.

    A demand that waits, and fits because another one books what both share, is not tried at once.
    """
    who = random.choice(VEHICLES)
    made = {"kind": "Demand", "demand": f"{who}-{random.randrange(3)}", "requesters": [who]}
    if random.random() < 0.25:
        return made | {"operation": "release"}
    vehicles = VEHICLES[1:] if alone else VEHICLES
    found = [recorder(random, vehicles) for _ in range(random.randint(1, 3))]
    apps = {app["id"]: app for app in found}
    if alone:
        apps = {id: app | {"id": f"{made['demand']}/{id}"} for id, app in apps.items()}
    return made | {"applications": list(apps.values()), "priority": random.randrange(2)}


def used(repo: MemoryRepo) -> Counter[str]:
    """Return, by node, how many cpus the booked services request."""
    found: Counter[str] = Counter()
    for entry in repo.books()["services"].values():
        topics = sum(map(len, entry["inputs"].values()))
        replicas = min(3, -(-topics // 2)) if entry["service"] == "recorder" else 1
        found[entry["node"]] += replicas
    return found


def book_waiting(repo: MemoryRepo) -> list[str]:
    """Try to book each waiting demand in order; return the ids of those that were booked."""
    booked = []
    for one in in_turn(repo.state.ledger.waiting):
        taken = repo.take(one.put)
        assert isinstance(taken, Decision)
        booked += [one.demand] if taken.outcome == "booked" else []
    return booked


@pytest.mark.parametrize("when_full", ["refuse", "wait"])
@examples(12)
@given(chances)
def test_no_node_gets_more_than_it_has_and_what_waits_does_not_fit_and_is_booked_in_turn(
    when_full: str, random: Random
) -> None:
    repo, sent = MemoryRepo(state=recorders(when_full)), dict[str, dict[str, Any]]()
    for _ in range(10):
        repo.now += timedelta(minutes=1)
        made = goal(random, alone=when_full == "wait")
        taken = repo.take(made)
        if isinstance(taken, Refused):
            codes = {fault.code for fault in taken.faults}
            assert "operation" not in made or codes == {"not-held"}
        elif taken.outcome == "waiting":
            sent[made["demand"]] = made
        if isinstance(taken, Decision) and taken.awaited:
            book_waiting(repo)
        now = used(repo)
        assert {id: repo.state.usage().of(id, "cpu") / 1000 for id in now} == dict(now)
        assert repo.state.usage().amounts == whole_usage(repo.state).amounts
        assert all(now[id] <= most for id, most in CAPACITY.items())
        waiting = in_turn(repo.state.ledger.waiting)
        assert not waiting or when_full == "wait"
        for one in waiting:
            assert one.put.goal == sent[one.demand]
            assert not repo.state.ledger.claims_with("demand", one.demand)
            assert repo.decide(one.put).outcome == "waiting"
        turns = [(-one.put.priority, one.since) for one in waiting]
        assert turns == sorted(turns)
        assert ledger_in(repo.files) == repo.state.ledger
    claims = list(repo.state.ledger)
    random.shuffle(claims)
    half = claims[: len(claims) // 2]
    known = repo.state
    known.usage()
    ledger = known.ledger.without(half)
    edited = known.with_ledger(ledger, [ClaimChange(claim, None) for claim in half])
    assert edited.usage().amounts == replace(known, ledger=ledger).usage().amounts


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


TABLES = plain_yaml.beside(__file__)


@pytest.mark.parametrize(("text", "thousandths", "of_cpu", "of_memory"), TABLES["quantities"])
def test_a_quantity_is_read_as_kubernetes_does(
    text: str, thousandths: int, of_cpu: str, of_memory: str
) -> None:
    assert amount_of(text) == thousandths
    assert amount_text(thousandths, "cpu") == of_cpu
    assert amount_text(thousandths, "memory") == of_memory


@pytest.mark.parametrize("text", TABLES["invalid"])
def test_an_invalid_quantity_is_a_fault(text: str) -> None:
    with pytest.raises(ValueError, match=r"is not a quantity|is finer than a thousandth"):
        amount_of(text)
