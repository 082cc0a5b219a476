"""A model of what runs: services, replicas, separate instances, connections and overrides.

It is written from what docs/connections.md, docs/appdef.md, docs/versions.md, docs/policy.md and
docs/overrides.md promise, and imports nothing of the program. In this model, each application of
the type ``FUSION`` runs one service, each demand for an instance has one application, and each
connection has a client at both ends.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from tests.model.books import Refused
from tests.model.listed import FUSION, Goal
from tests.model.places import Places

TALLY = "tally"
"""The type with separate instances, which need a replica per topic, and ``MOST`` at most."""
DEFAULT, NEXT = "1.0.0", "1.1.0"
HALL, FIRST, FURTHER = "hall", "hall@perception", "hall@city"
"""A node in two access domains, its name in the first one, and its name in the further one."""
MAY = {
    "vehicle00": frozenset({HALL}),
    "vehicle01": frozenset({HALL, FURTHER}),
    "traffic": frozenset({FURTHER}),
}
"""For each requester, the names under which it may demand the node ``hall``."""
MOST = 3

Service = tuple[str, str]
"""An application's id, and its node."""
Link = tuple[str, str, str]
"""A connection's id, source and target."""
CITY_QUOTA = 1


@dataclass(frozen=True)
class Override:
    """An override of replicas of the services on ``nodes``, or one that denies ``connections``."""

    name: str
    nodes: frozenset[str] = frozenset()
    connections: frozenset[str] = frozenset()
    replicas: int | None = None
    priority: int = 0
    end: datetime | None = None

    @classmethod
    def read(cls, name: str, file: Mapping[str, Any]) -> Override:
        (selector,) = file["select"]
        end = file.get("expires")
        return cls(
            name,
            frozenset(selector.get("nodes", ())),
            frozenset(selector.get("connections", ())),
            file.get("replicas"),
            file.get("priority", 0),
            datetime.fromisoformat(str(end).replace("Z", "+00:00")) if end else None,
        )


@dataclass
class Running(Places):
    """Adds separate instances, what runs, and the overrides in effect."""

    testing: str = NEXT
    overrides: frozenset[Override] = frozenset()

    def _taken(self, goal: Goal, now: float, received: str) -> str:
        """Refuse also what is new for a denied connection, or beyond ``CITY_QUOTA``."""
        app: dict[str, Any] = next(iter(goal.get("applications", [])), {})
        tallies = app.get("type") == TALLY
        if tallies:
            goal = goal | {"applications": [self._chosen(app, goal["requesters"])]}
        denied = {one["id"] for one in goal.get("connections", ())} & self.denied()
        had, counts = self._holds(denied), self._claims_in_city()
        outcome = super()._taken(goal, now, received)
        for name, count in self._claims_in_city().items() if tallies else ():
            if count > max(CITY_QUOTA, counts[name]):
                raise Refused("the quota of the domain is used up")
        if outcome == "booked" and self._holds(denied) != had:
            raise Refused("it is denied by an override")
        return outcome

    def _claims_in_city(self) -> Counter[str]:
        here = (claim for _, claim in self.on("application") if claim.fixed["node"] == FURTHER)
        return Counter(name for claim in here for name in claim.who)

    def denied(self) -> frozenset[str]:
        return frozenset().union(*(one.connections for one in self.overrides))

    def _holds(self, connections: set[str]) -> dict[Any, Any]:
        return {
            key: (claim.content(), claim.who)
            for key, claim in self.claims.items()
            if key[0][0] == "connection" and key[0][1] in connections
        }

    def services(self) -> dict[Service, tuple[list[str], int]]:
        topics: dict[Service, set[str]] = {}
        for id, claim in self.on("application"):
            if claim.fixed["type"] == FUSION:
                read = topics.setdefault((id, claim.fixed["node"]), set())
                read |= {topic for _, topic, _ in claim.topics}
        return {key: (sorted(read), self._replicas_on(key[1])) for key, read in topics.items()}

    def _replicas_on(self, node: str) -> int:
        found = [(one.priority, one.replicas) for one in self.overrides if node in one.nodes]
        return max(found)[1] or 0 if found else 1

    def links(self) -> dict[Link, dict[str, str]]:
        routes: dict[Link, dict[str, str]] = {}
        for id, claim in self.on("connection"):
            if id not in self.denied():
                link = id, claim.fixed["source"], claim.fixed["target"]
                carried = {topic: target for (topic,), target in claim.topics.items()}
                routes.setdefault(link, {}).update(carried)
        return routes

    def _chosen(self, app: dict[str, Any], who: list[str]) -> dict[str, Any]:
        asked = app["version"]
        version = self.testing if asked == "testing" else asked or DEFAULT
        asked = asked and version  # a claim records the version, not the channel
        id = app["id"].removesuffix(f"@{NEXT}")
        if version == NEXT:
            id = f"{id}@{NEXT}"
        elif app["id"] != id:
            raise Refused("the id is that of another version")
        node = HALL if app["node"] == FIRST else app["node"]
        if app["node"] == HALL:
            booked = {on for other, on in self.demanded() if other == id}
            allowed = {one for one in (HALL, FURTHER) if all(one in MAY[name] for name in who)}
            if len(choice := booked or allowed) != 1:
                raise Refused("the domain is not clear")
            (node,) = choice
        if any(node not in MAY[name] for name in who):
            raise Refused("it may not demand the node")
        return app | {"id": id, "node": node, "version": asked}

    def demanded(self) -> dict[Service, frozenset[str]]:
        found: dict[Service, frozenset[str]] = {}
        for id, claim in self.on("application"):
            if claim.fixed["type"] == TALLY:
                one = id, claim.fixed["node"]
                topics = (topic for _, topic, _ in claim.topics)
                found[one] = found.get(one, frozenset()).union(topics)
        return found

    def replicas(self, one: Service) -> int:
        return min(MOST, len(self.demanded()[one]))
