"""Demands put, renewed, released and left to expire in any order, as time passes and with restarts.

Held against ``tests/model/leases.py``, which knows what is promised and not the program.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from itertools import combinations
from random import Random
from typing import Any

from demandops.config.load import load
from demandops.decision import Decision, State
from demandops.demand.application import Application
from demandops.demand.claim import Claim, demand_id
from demandops.ledger import claim_file
from demandops.ledger.ledger import Ledger
from demandops.ledger.recent_shutdowns import RecentShutdowns
from hypothesis import given, note
from hypothesis import strategies as st

from tests.kit.chance import chances, examples
from tests.kit.memory import ledger_in
from tests.model.leases import Goal, Promises, Subject, by_message
from tests.scenarios import running

SLACK_S = 30
DOMAIN = {
    "name": "perception",
    "namespace": "perception",
    "nodes": ["*"],
    "leases": {"slack": f"{SLACK_S}s"},
}
FILES = running.configuration((), {"policy/access-domains.yaml": {"domains": [DOMAIN]}})
EMPTY = State.of(load(FILES), Ledger())
DEMANDS = ("d0", "d1", "D1", "d/2")
PEOPLE = ("vehicle00", "vehicle01", "station00")
LEASES = (None, 10, 60, 90)
PAUSES = (1, 1, 2, 5, 10, 11, 29, 30, 31, 59, 60, 61, 90, 91, 121, 900, 3600)


class Maker:
    """Makes requests by chance: few demands, people and subjects, so that they meet."""

    def __init__(self, random: Random) -> None:
        self._random = random
        self._puts: list[Goal] = []
        self._shutdowns: list[Goal] = []

    def any(self) -> Goal:
        kind = self._random.randrange(20)
        if self._puts and kind < 9:
            return self._of_known(kind)
        if kind < 14:
            self._puts.append(self.put())
            return self._puts[-1]
        if kind < 16:
            return self._named("release" if kind == 14 else "renew")
        if kind == 19 and self._shutdowns:
            return self._random.choice(self._shutdowns[-2:])
        return self._message(shutdown=kind > 17)

    def _of_known(self, kind: int) -> Goal:
        """Return a renewal of what was put, the same again, the same with another lease."""
        known = self._random.choice(self._puts[-2:])
        if kind < 3:
            return {key: known[key] for key in ("kind", "demand", "requesters")} | {
                "operation": "renew"
            }
        return known if kind < 6 else known | {"lease": self._random.choice(LEASES[1:])}

    def put(self) -> Goal:
        made = self._named("put")
        lease = self._random.choice(LEASES)
        if lease is not None:
            made["lease"] = lease
        made["applications"] = [self._application(id) for id in self._some("ab")]
        made["connections"] = [self._connection(id) for id in self._some("xy")]
        return made

    def _named(self, operation: str) -> Goal:
        people = self._some(PEOPLE) or [self._random.choice(PEOPLE)]
        return {
            "kind": "Demand",
            "operation": operation,
            "demand": self._random.choice(DEMANDS),
            "requesters": people,
        }

    def _some(self, of: Any) -> list[Any]:
        return [one for one in of if self._random.randrange(2)]

    def _application(self, id: str) -> dict[str, Any]:
        topics = [{"topic": f"/ego{number}", "source": "vehicle00"} for number in self._some("12")]
        return {
            "id": id,
            "type": "object-detection-fusion",
            # mostly the same: else all contradict each other
            "node": self._random.choice(["edge", "edge", "edge", "cloud"]),
            "connect": "none",
            "inputs": {"ego_data": topics or [{"topic": "/ego3", "source": "vehicle00"}]},
        }

    def _connection(self, id: str) -> dict[str, Any]:
        topics = [{"source": f"/{name}"} for name in self._some("pq")]
        if not self._random.randrange(6):
            topics = [{"source": "/p", "target": "/elsewhere"}]
        source = "station00" if not self._random.randrange(6) else "vehicle00"
        topics = topics or [{"source": "/r"}]
        return {"id": id, "source": source, "target": "edge", "topics": topics}

    def _message(self, *, shutdown: bool) -> Goal:
        topics = [f"/{name}" for name in self._some("pq")]
        topics = topics if shutdown else topics or ["/p"]
        item = {
            "id": self._random.choice("xy"),
            "type": 1,
            "requester_ids": self._some(PEOPLE) or [PEOPLE[0]],
            "source_node_id": "vehicle00",
            "target_node_id": "edge",
            "source_topics": topics,
            "target_topics": topics,
        }
        request = self._random.choice(["m0", "m1"])
        made = {"id": request, "shutdown": shutdown, "connections": [item]}
        if shutdown:
            self._shutdowns.append(made)
        return made


Name = tuple[str, Subject]


MESSAGES = {
    demand_id(request, who): by_message(request, who)
    for request in ("m0", "m1")
    for count in (1, 2, 3)
    for who in combinations(PEOPLE, count)
}


def name_of(claim: Claim) -> Name:
    """Return what the model knows a claim by."""
    demand = MESSAGES.get(claim.demand, claim.demand)
    return demand, (claim.subject.kind.value, claim.subject.id)


def claims_of(world: running.World) -> dict[Name, tuple[dict[str, Any], frozenset[str]]]:
    found = {}
    for claim in world.state.ledger:
        what: dict[str, Any]
        held = claim.held
        if isinstance(held, Application):
            inputs = {
                role: frozenset((topic.source, topic.topic) for topic in topics)
                for role, topics in held.inputs.items()
            }
            what = {"type": held.appdef, "node": held.node, "inputs": inputs}
            what["parameters"] = dict(held.parameters)
        else:
            topics = {route.source: route.target for route in held.topics}
            what = {"source": held.source, "target": held.target, "topics": topics}
            what["holds"] = {one: frozenset(claim.holders((one,))) for one in topics}
        found[name_of(claim)] = what, frozenset(claim.requesters)
    return found


def restart(world: running.World, random: Random) -> None:
    """Go on from the files alone, read in any order."""
    files = random.sample(sorted(world.files.items()), len(world.files))
    ledger = ledger_in(dict(files))
    assert ledger == world.state.ledger
    world.state = replace(world.state, ledger=ledger)
    world.restart()


def assert_released(world: running.World, promises: Promises, now: int) -> None:
    """Look at the leases: what must go goes, what may not does not, one commit a demand."""
    before = set(claims_of(world))
    demands = world.look()
    assert len(demands) == len(set(demands))
    released = before - set(claims_of(world))
    assert promises.must_go(now) <= released <= promises.may_go(now)
    assert {demand for demand, _ in released} == set(demands)
    promises.gone(released)


def assert_outcome(taken: Any, expected: str, promises: Promises) -> None:
    outcome = taken.outcome if isinstance(taken, Decision) else "refused"
    if (outcome, expected) == ("booked", "unchanged"):
        assert taken.releases == ()
        for change in taken.changes.claims:  # only the time that is recorded
            assert change.before.lease != change.after.lease
            assert change.before.booked == change.after.booked
    else:
        assert outcome == expected, taken


def assert_recorded(world: running.World, promises: Promises) -> None:
    """The record lags behind what was promised by the slack at most, and is never ahead."""
    for claim in world.state.ledger:
        demand, subject = name_of(claim)
        promised = promises.held[demand][subject].promised
        assert (claim.lease is None) == (promised is None)
        if claim.lease is not None and promised is not None:
            end = running.START + timedelta(seconds=promised)
            assert claim.lease.until <= end <= claim.lease.expires_at


@examples(60)
@given(chances, st.integers(1, 16))
def test_what_was_promised_is_kept(random: Random, length: int) -> None:
    world, promises, maker = running.World(EMPTY, FILES), Promises(SLACK_S), Maker(random)
    now = 0
    for _ in range(length):
        pause = random.choice(PAUSES)
        now += pause
        world.clock.pass_(pause)
        if not random.randrange(4):
            restart(world, random)
        note(f"at {now}:")
        assert_released(world, promises, now)
        goal = maker.any()
        note(repr(goal))
        expected = promises.take(goal, now)
        taken = world.take(goal)
        assert_outcome(taken, expected, promises)
        assert claims_of(world) == promises.claims()
        assert_recorded(world, promises)
        if isinstance(taken, Decision) and taken.request.adds_claims:
            again = world.take(goal)
            assert isinstance(again, Decision)
            assert (again.outcome, dict(again.files)) == ("unchanged", {})
    world.assert_sound()
    leave_all(world, promises, now)


def leave_all(world: running.World, promises: Promises, now: int) -> None:
    """Let every lease end and release the rest: nothing of anybody stays."""
    world.clock.pass_(2 * 3600)
    assert_released(world, promises, now + 2 * 3600)
    for claim in list(world.state.ledger):
        if world.state.ledger.get(claim.key) is None:
            continue  # went with another of its demand
        release = {"kind": "Demand", "operation": "release", "demand": claim.demand}
        world.take(release | {"requesters": list(claim.requesters)})
    assert replace(world.state.ledger, shutdowns=RecentShutdowns()) == Ledger()
    assert world.rendered() == {}
    assert not [path for path in world.files if claim_file.kind_of(path)]
