"""A model of separate instances, of a node in two access domains, and of replicas.

It is written from what docs/versions.md, docs/policy.md and docs/appdef.md promise, and imports
nothing of the program. In this model, each demand for an instance has one application, which runs
one service.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tests.model.leases import Goal
from tests.model.places import Outcome, Places

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

    def take(self, goal: Goal, now: int, received: str = "") -> Outcome:
        app: dict[str, Any] = next(iter(goal.get("applications", [])), {})
        if app.get("type") == TALLY:
            chosen = self._chosen(app, goal["requesters"])
            if chosen is None:
                return "refused"
            goal = goal | {"applications": [chosen]}
        return super().take(goal, now, received)

    def _chosen(self, app: dict[str, Any], who: list[str]) -> dict[str, Any] | None:
        """Return ``app`` with the id, node and version for its claim; None to refuse the demand."""
        asked = app["version"]
        version = self.testing if asked == "testing" else asked or DEFAULT
        asked = asked and version  # a claim records the version, not the channel
        id = app["id"].removesuffix(f"@{NEXT}")
        if version == NEXT:
            id = f"{id}@{NEXT}"
        elif app["id"] != id:
            return None
        node = HALL if app["node"] == FIRST else app["node"]
        if app["node"] == HALL:
            booked = {on for other, on in self.demanded() if other == id}
            allowed = {one for one in (HALL, FURTHER) if all(one in MAY[name] for name in who)}
            if len(choice := booked or allowed) != 1:
                return None
            (node,) = choice
        if any(node not in MAY[name] for name in who):
            return None
        return app | {"id": id, "node": node, "version": asked}

    def demanded(self) -> dict[Instance, frozenset[Any]]:
        found: dict[Instance, frozenset[Any]] = {}
        for subjects in self.held.values():
            for (_, id), held in subjects.items():
                if held.what.get("type") == TALLY:
                    one = id, held.what["node"]
                    found[one] = found.get(one, frozenset()) | held.what["inputs"]["ego_data"]
        return found

    def replicas(self, one: Instance) -> int:
        return min(MOST, len(self.demanded()[one]))
