"""Random requests with leases."""

from __future__ import annotations

from random import Random
from typing import Any

from tests.model.listed import Goal

DEMANDS = ("d0", "d1", "D1", "d/2")
PEOPLE = ("vehicle00", "vehicle01", "station00")
LEASES = (None, 10, 60, 90)


class Maker:
    """Makes random requests about few demands and subjects, so that requests often overlap."""

    def __init__(self, random: Random) -> None:
        self._random = random
        self._puts: list[Goal] = []
        self._shutdowns: list[Goal] = []

    def any(self) -> Goal:
        kind = self._random.randrange(20)
        if self._puts and kind < 9:
            return self._again(kind)
        if kind < 14:
            self._puts.append(self.put())
            return self._puts[-1]
        if kind < 16:
            return self._named("release" if kind == 14 else "renew")
        if kind == 19 and self._shutdowns:
            return self._random.choice(self._shutdowns[-2:])
        return self._message(shutdown=kind > 17)

    def _again(self, kind: int) -> Goal:
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
            # mostly the same node, because otherwise most demands contradict each other
            "node": self._random.choice(["edge", "edge", "edge", "cloud"]),
            "connect": "none",
            "inputs": {"ego_data": topics or [{"topic": "/ego3", "source": "vehicle00"}]},
        }

    def _connection(self, id: str) -> dict[str, Any]:
        # no other connection has them, so the model needs not know which one carries a topic
        topics = [{"source": f"/{id}{name}"} for name in self._some("pq")]
        if not self._random.randrange(6):
            topics = [{"source": f"/{id}p", "target": "/elsewhere"}]
        source = "station00" if not self._random.randrange(6) else "vehicle00"
        topics = topics or [{"source": f"/{id}r"}]
        return {"id": id, "source": source, "target": "edge", "topics": topics}

    def _message(self, *, shutdown: bool) -> Goal:
        id = self._random.choice("xy")
        topics = [f"/{id}{name}" for name in self._some("pq")]
        topics = topics if shutdown else topics or [f"/{id}p"]
        item = {
            "id": id,
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
