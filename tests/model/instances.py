"""A model of separate instances, of a node in two access domains, and of replicas.

It is written from what docs/versions.md, docs/policy.md and docs/appdef.md promise, and imports
nothing of the program. In this model, each demand for an instance has one application, which runs
one service.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tests.model.books import Refused
from tests.model.listed import Goal
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

Instance = tuple[str, str]
"""An application's id, and its node."""


@dataclass
class Instances(Places):
    """Adds separate instances."""

    testing: str = NEXT

    def _taken(self, goal: Goal, now: float, received: str) -> str:
        app: dict[str, Any] = next(iter(goal.get("applications", [])), {})
        if app.get("type") == TALLY:
            goal = goal | {"applications": [self._chosen(app, goal["requesters"])]}
        return super()._taken(goal, now, received)

    def _chosen(self, app: dict[str, Any], who: list[str]) -> dict[str, Any]:
        """Return ``app`` with the id, node and version for its claim."""
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

    def demanded(self) -> dict[Instance, frozenset[str]]:
        """Return the topics that the demands for each instance list."""
        found: dict[Instance, frozenset[str]] = {}
        for id, claim in self.on("application"):
            if claim.fixed["type"] == TALLY:
                one = id, claim.fixed["node"]
                topics = (topic for _, topic, _ in claim.topics)
                found[one] = found.get(one, frozenset()).union(topics)
        return found

    def replicas(self, one: Instance) -> int:
        return min(MOST, len(self.demanded()[one]))
