"""A model of demands without a node, of full and drained nodes, and of waiting.

It is written from what docs/placement.md promises, and imports nothing of the program. In this
model, a demand without a node has one application, which no other demand has, and each of the
``nodes`` has room for one application. The generator may choose any free node: ``chosen`` has the
nodes that it has chosen, and the model checks that they are free.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from tests.model.books import Books, Key, Refused
from tests.model.listed import Claim, Goal, Subject


@dataclass(frozen=True)
class Waiting:
    priority: int
    since: str
    who: frozenset[str]
    goal: Goal

    def turn(self, demand: str) -> tuple[int, str, str]:
        return -self.priority, self.since, demand


@dataclass
class Places(Books):
    """Adds demands that wait for room on ``nodes``; ``drained`` nodes get no applications."""

    nodes: frozenset[str] = frozenset()
    drained: frozenset[str] = frozenset()
    waiting: dict[str, Waiting] = field(default_factory=dict)
    chosen: Mapping[Subject, str] = field(default_factory=dict)
    """The node that the generator has chosen for each application, if known."""

    def _taken(self, goal: Goal, now: float, received: str) -> str:
        """Answer ``waiting`` if a put adds or changes what waits, ``waits`` if it repeats it."""
        demand, who = goal.get("demand", ""), frozenset(goal.get("requesters", ()))
        waits = self.waiting.get(demand)
        if waits and goal.get("operation", "put") != "put":
            if who != waits.who:
                raise Refused("it is a demand of others")
            if goal["operation"] == "renew":
                return "unchanged"
            del self.waiting[demand]
            return "released"
        if not any("place" in app for app in goal.get("applications", [])):
            return super()._taken(goal, now, received)
        for subject, claim in self.of(demand).items():
            return self._put_again(goal, now, subject, claim)
        if waits and who != waits.who:
            raise Refused("it is a demand of others")
        if self.free():
            first = min(self.waiting, key=self._turn, default=demand)
            # if the generator has chosen a node, no other demand may wait in front of this one
            assert first == demand or not self.chosen, f"{first} waits, but {demand} gets room"
            return self._place(demand, goal, now)
        if self.nodes <= self.drained:
            raise Refused("all nodes are drained")
        since = waits.since if waits else received
        self.waiting[demand] = Waiting(goal.get("priority", 0), since, who, goal)
        return "waits" if self.waiting[demand] == waits else "waiting"

    def _put_again(self, goal: Goal, now: float, subject: Subject, claim: Claim) -> str:
        """Apply a put to a demand that has a node, where it stays unless the node is drained."""
        node: str = claim.fixed["node"]
        if node in self.drained and claim.who == tuple(sorted({*goal["requesters"]})):
            if not self.free():
                raise Refused("no node has room")
            node = self._chosen_node(subject)
        return super()._taken(_at(goal, node), now, "")

    def _place(self, demand: str, goal: Goal, now: float) -> str:
        self.waiting.pop(demand, None)
        node = self._chosen_node(("application", goal["applications"][0]["id"]))
        return super()._taken(_at(goal, node), now, "")

    def _chosen_node(self, subject: Subject) -> str:
        node = self.chosen.get(subject) or min(self.free())
        assert node in self.free(), f"{subject} is placed on {node}, but {self.free()} are free"
        return node

    def _turn(self, demand: str) -> tuple[int, str, str]:
        return self.waiting[demand].turn(demand)

    def free(self) -> frozenset[str]:
        taken = {claim.fixed["node"] for _, claim in self.on("application")}
        return self.nodes - self.drained - taken

    def book_waiting(self, demand: str, now: float) -> None:
        """Book the demand that must be first in turn; ``now`` is the earliest time for it."""
        assert demand in self.waiting, f"{demand} is booked, and did not wait"
        first = min(self.waiting, key=self._turn)
        assert demand == first, f"{demand} is booked before {first}"
        self._place(demand, self.waiting[demand].goal, now)

    def moved(self, key: Key) -> None:
        fixed = self.claims[key].fixed
        assert fixed["node"] in self.drained, f"{key} moved off a node that is not drained"
        fixed["node"] = self._chosen_node(key[0])

    def drain(self, node: str, drained: bool) -> None:
        self.drained = self.drained | {node} if drained else self.drained - {node}

    def waiting_files(self) -> dict[str, tuple[int, str, frozenset[str]]]:
        return {name: (one.priority, one.since, one.who) for name, one in self.waiting.items()}


def _at(goal: Goal, node: str) -> Goal:
    app = {key: value for key, value in goal["applications"][0].items() if key != "place"}
    return goal | {"applications": [app | {"node": node}]}
