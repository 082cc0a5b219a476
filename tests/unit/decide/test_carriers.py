"""Whatever is demanded in whichever order, one connection carries a route as long as it is held."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any

from demandops.base.errors import Refused
from demandops.connections.connection import Connection, RouteKey
from demandops.decide.booking import Restoration
from demandops.decide.carriers import with_one_carrier
from demandops.decide.edits import faults_of_edit
from demandops.model.ledger.claim import Claim, path_of
from demandops.model.ledger.ledger import ClaimChange, ledger_of
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples
from tests.kit.memory import MemoryRepo

SOURCES, TARGETS = ("vehicle00", "vehicle01", "edge"), ("edge", "cloud", "vehicle00")
TOPICS = ("/a", "/b", "/c")
BROKERS = {
    "inventory/brokers.yaml": (
        "apiVersion: demandops/v1\nkind: Brokers\n"
        "brokers: [{node: edge, host: e}, {node: cloud, host: c}]\n"
    )
}


class Parties:
    """Requesters that demand at random by both actions, and repeat and end what they demanded."""

    def __init__(self, random: Random) -> None:
        self.random = random
        self.sent: list[dict[str, Any]] = []

    def next(self) -> dict[str, Any]:
        if self.sent and self.random.random() < 0.2:
            return self.random.choice(self.sent)
        who = self.random.sample(("v", "s", "w"), self.random.randint(1, 2))
        number = self.random.randint(0, 2)
        goal = self._put(number) if self.random.random() < 0.5 else self._join(number, who)
        self.sent.append(goal)
        return goal

    def endings(self) -> list[dict[str, Any]]:
        ended = []
        for goal in self.sent:
            if "id" in goal:
                ended.append(goal | {"shutdown": True})
            elif goal["operation"] == "put":
                ended.append({**_release(goal["demand"]), "requesters": goal["requesters"]})
        self.random.shuffle(ended)
        return ended

    def _put(self, number: int) -> dict[str, Any]:
        demand = {"kind": "Demand", "demand": f"d{number}", "requesters": [f"of{number}"]}
        if self.random.random() < 0.2:
            return demand | {"operation": "release"}
        applications = [
            {
                "id": f"f{each}",
                "type": "object-detection-fusion",
                "node": "edge",
                "connect": self.random.choice(
                    ["auto", "mqtt", {"type": "mqtt", "broker": "cloud"}]
                ),
                "inputs": {"ego_data": self._inputs("topic", "source")},
                "deliver": [
                    {"output": "object-fusion.fused_objects", "node": node, "topic": topic}
                    for node in self.random.sample(TARGETS[1:], self.random.randint(0, 1))
                    for topic in self.random.sample(("", "/b"), 1)
                ],
            }
            for each in self.random.sample((0, 1), self.random.randint(0, 2))
        ]
        connections = [
            {
                "id": f"c{each}",
                "source": source,
                "target": target,
                "broker": self.random.choice(("", "edge", "cloud")),
                "topics": [
                    {
                        "source": topic,
                        "target": self.random.choice((topic, topic, *TOPICS)),
                        "reverse": self.random.random() < 0.2,
                        "qos": int(self.random.random() < 0.1),
                    }
                    for topic in self.random.sample(TOPICS, self.random.randint(1, 2))
                ],
            }
            for each in self.random.sample((0, 1, 2), self.random.randint(not applications, 2))
            for source, target in [self._ends()]
        ]
        more = {"applications": applications, "connections": connections}
        return demand | {"operation": "put"} | more

    def _join(self, number: int, who: list[str]) -> dict[str, Any]:
        body = {
            "requester_ids": who,
            "ego_data_topics": self._inputs("topic_name", "source_node_id"),
        }
        apps = [
            {
                "header": {"id": f"f{each}", "node_id": "edge"},
                "type": 1,
                "object_detection_fusion_app": body,
            }
            for each in self.random.sample((0, 1), self.random.randint(0, 2))
        ]
        connections = []
        for each in self.random.sample((0, 1, 2), self.random.randint(not apps, 2)):
            source, target = self._ends()
            topics = self.random.sample(TOPICS, self.random.randint(1, 2))
            connections.append(
                {
                    "id": f"c{each}",
                    "type": 1,
                    "requester_ids": who,
                    "source_node_id": source,
                    "target_node_id": target,
                    "source_topics": topics,
                    "target_topics": [self.random.choice((t, t, *TOPICS)) for t in topics],
                }
            )
        shutdown = self.random.random() < 0.3
        return {"id": f"r{number}", "shutdown": shutdown, "apps": apps, "connections": connections}

    def _ends(self) -> tuple[str, str]:
        source = self.random.choice(SOURCES)
        return source, self.random.choice([node for node in TARGETS if node != source])

    def _inputs(self, topic: str, source: str) -> list[dict[str, str]]:
        pairs = {
            (self.random.choice(TOPICS), self.random.choice(SOURCES))
            for _ in range(self.random.randint(1, 2))
        }
        return [{topic: name, source: node} for name, node in sorted(pairs)]


def _release(demand: str) -> dict[str, Any]:
    return {"kind": "Demand", "operation": "release", "demand": demand}


def carriers(repo: MemoryRepo) -> dict[RouteKey, str]:
    """Return the id of the connection that carries each route; there must be only one."""
    found: dict[RouteKey, set[str]] = {}
    for claim in repo.state.ledger:
        if not claim.is_on_application:
            for route in claim.connection.topics:
                key = claim.connection.key_of(route)
                found.setdefault(key, set()).add(claim.subject.id)
    assert all(len(ids) == 1 for ids in found.values()), found
    return {key: min(ids) for key, ids in found.items()}


@examples(60)
@given(chances, st.integers(1, 14))
def test_one_connection_carries_a_route_as_long_as_anybody_holds_it(
    random: Random, length: int
) -> None:
    parties, repo = Parties(random), MemoryRepo(BROKERS)
    for _ in range(length):
        before = carriers(repo)
        goal = parties.next()
        taken = repo.take(goal)
        after = carriers(repo)
        assert {key: after[key] for key in before.keys() & after.keys()} == {
            key: before[key] for key in before.keys() & after.keys()
        }
        if not isinstance(taken, Refused) and not goal.get("shutdown"):
            again = repo.decide(goal) if goal.get("operation") != "release" else None
            assert again is None or again.outcome == "unchanged", goal
    for goal in parties.endings():
        repo.take(goal)
    assert not [*repo.state.ledger], "what nobody demands is left"


def listing(demand: str, id: str, *topics: dict[str, Any]) -> dict[str, Any]:
    ends = {"id": id, "source": "vehicle00", "target": "edge", "topics": list(topics)}
    return {"kind": "Demand", "demand": demand, "requesters": [demand], "connections": [ends]}


def doubled() -> list[Claim]:
    """Return the claims of two demands that list one route, as each would hold it alone."""
    asked = {
        "late": listing("late", "new", {"source": "/a", "qos": 1}, {"source": "/b"}),
        "early": listing("early", "old", {"source": "/a"}),
    }
    claims = []
    for hour, (_, goal) in zip((11, 9), asked.items(), strict=True):
        repo = MemoryRepo()
        repo.send(goal, repo.now.replace(hour=hour))
        claims += list(repo.state.ledger)
    return claims


def test_an_upgrade_gives_a_route_to_the_oldest_connection_that_has_it() -> None:
    ledger, keys = with_one_carrier(ledger_of(doubled()))
    held = {
        (claim.subject.id, claim.demand): [(r.source, r.qos, r.listed) for r in claim.held.topics]
        for claim in ledger
        if isinstance(claim.held, Connection)
    }
    assert held == {
        ("old", "early"): [("/a", 0, "")],
        ("old", "late"): [("/a", 0, "new")],
        ("new", "late"): [("/b", 0, "")],
    }
    assert {key.subject.id for key in keys} == {"old", "new"}
    assert with_one_carrier(ledger) == (ledger, [])


def test_a_claim_by_hand_that_doubles_a_route_is_invalid_and_a_restored_one_is_united() -> None:
    late, early = doubled()
    repo = MemoryRepo()
    before = replace(repo.state, ledger=ledger_of([early]))
    after = replace(repo.state, ledger=ledger_of([early, late]))
    (found,) = faults_of_edit(before, after, [ClaimChange(None, late)])
    assert (found.file, found.field) == (path_of(late.key), "topics[0]")
    assert "connection 'old' carries this topic" in found.message
    repo.send(Restoration(id="rollback", claims=(late, early)))
    assert set(carriers(repo).values()) == {"old", "new"}
