"""A model of separate instances, of a node in two access domains, and of kept replicas.

It is written from what docs/versions.md, docs/policy.md and docs/appdef.md promise, and imports
nothing of the program. In this model, each demand for an instance has one application, which runs
one service.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
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
KEPT_FOR = timedelta(seconds=120)

Instance = tuple[str, str]
"""An application's id, and its node."""


@dataclass
class Instances(Places):
    """Adds separate instances; ``kept[one] == {3: t}`` if one keeps a third replica until ``t``."""

    testing: str = NEXT
    kept: dict[Instance, dict[int, datetime]] = field(default_factory=dict)

    def take(self, goal: Goal, now: int, received: str = "") -> Outcome:
        before = self.demanded()
        app: dict[str, Any] = next(iter(goal.get("applications", [])), {})
        if app.get("type") == TALLY:
            chosen = self._chosen(app, goal["requesters"])
            if chosen is None:
                return "refused"
            goal = goal | {"applications": [chosen]}
        outcome = super().take(goal, now, received)
        self.keep(before, datetime.fromisoformat(received.replace("Z", "+00:00")))
        return outcome

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

    def keep(self, before: Mapping[Instance, frozenset[Any]], now: datetime) -> None:
        """Keep replicas that have become superfluous, until ``KEPT_FOR`` after ``now``."""
        after = self.demanded()
        for one in before.keys() | after.keys():
            least, had = needed(after.get(one, ())), needed(before.get(one, ()))
            kept = self.kept.pop(one, {}) | dict.fromkeys(range(least + 1, had + 1), now + KEPT_FOR)
            if least and (kept := {number: kept[number] for number in kept if number > least}):
                self.kept[one] = kept

    def come_down(self, one: Instance, record: Mapping[int, datetime], now: datetime) -> None:
        """Take over the program's ``record``, which may lack only what is over."""
        least = needed(self.demanded().get(one, ()))
        kept, told = _ends(self.kept.get(one, {}), least), _ends(record, least)
        for number in kept.keys() - told.keys():
            assert kept[number] <= now, f"{one} came down from {number} before {kept[number]}"
        assert told.items() <= kept.items(), f"{one} keeps {told}, but expected {kept}"
        self.kept.pop(one, None)
        if told:
            self.kept[one] = told

    def replicas(self, one: Instance) -> int:
        return max(needed(self.demanded()[one]), *self.kept.get(one, ()), 0)


def _ends(kept: Mapping[int, datetime], least: int) -> dict[int, datetime]:
    """Map each number of replicas above ``least`` to the time when fewer than that remain."""
    return {
        number: max(end for one, end in kept.items() if one >= number)
        for number in range(least + 1, max(kept, default=0) + 1)
    }


def needed(topics: Collection[Any]) -> int:
    return min(MOST, len(topics))
