"""A model of what runs: the services of applications, the routes of connections, and overrides.

It is written from what docs/connections.md, docs/appdef.md and docs/overrides.md promise, and
imports nothing of the program. In this model, each application of the type ``FUSION`` runs one
service, and each connection has a client at both ends.
"""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from tests.model.instances import FURTHER, TALLY, Instances
from tests.model.leases import Goal, Held, Subject
from tests.model.places import Outcome

FUSION = "object-detection-fusion"

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
class Running(Instances):
    """Adds what runs, and the overrides in effect."""

    overrides: frozenset[Override] = frozenset()

    def take(self, goal: Goal, now: int, received: str = "") -> Outcome:
        """Refuse also what is new for a denied connection, or beyond ``CITY_QUOTA``."""
        denied = {one["id"] for one in goal.get("connections", ())} & self.denied()
        tallies = any(one.get("type") == TALLY for one in goal.get("applications", ()))
        if goal.get("shutdown") or not (denied or tallies):
            return super().take(goal, now, received)
        before = pickle.dumps(self.__dict__)
        had, counts = self._holds(denied), self._claims_in_city()
        outcome = super().take(goal, now, received)
        is_over = any(
            count > max(CITY_QUOTA, counts[name]) for name, count in self._claims_in_city().items()
        )
        if is_over or (outcome == "booked" and self._holds(denied) != had):
            self.__dict__.update(pickle.loads(before))  # noqa: S301 - bytes of this model
            return "refused"
        return outcome

    def content(self, demand: str) -> dict[Subject, tuple[dict[str, Any], frozenset[str]]]:
        held = self.held.get(demand, {})
        return {subject: (deepcopy(one.what), one.requesters) for subject, one in held.items()}

    def _claims_in_city(self) -> Counter[str]:
        here = (held for _, _, held in self._each("applications") if held.what["node"] == FURTHER)
        return Counter(name for held in here for name in held.requesters)

    def denied(self) -> frozenset[str]:
        return frozenset().union(*(one.connections for one in self.overrides))

    def _holds(self, connections: set[str]) -> dict[Any, Any]:
        return {
            (demand, subject): (dict(held.what), held.requesters)
            for demand, subject, held in self._each("connections")
            if subject in connections
        }

    def _each(self, kind: str) -> list[tuple[str, str, Held]]:
        return [
            (demand, subject[1], held)
            for demand, subjects in self.held.items()
            for subject, held in subjects.items()
            if subject[0] == kind
        ]

    def services(self) -> dict[Service, tuple[list[str], int]]:
        topics: dict[Service, set[str]] = {}
        for _, id, held in self._each("applications"):
            if held.what["type"] == FUSION:
                read = topics.setdefault((id, held.what["node"]), set())
                read |= {topic for _, topic in held.what["inputs"]["ego_data"]}
        return {key: (sorted(read), self._replicas_on(key[1])) for key, read in topics.items()}

    def _replicas_on(self, node: str) -> int:
        found = [(one.priority, one.replicas) for one in self.overrides if node in one.nodes]
        return max(found)[1] or 0 if found else 1

    def links(self) -> dict[Link, dict[str, str]]:
        routes: dict[Link, dict[str, str]] = {}
        for _, id, held in self._each("connections"):
            if id not in self.denied():
                link = id, held.what["source"], held.what["target"]
                routes.setdefault(link, {}).update(held.what["topics"])
        return routes
