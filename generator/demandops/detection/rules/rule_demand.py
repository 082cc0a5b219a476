"""What a rule demands: a template for goals of one of the two actions.

The template makes the goals that start, renew and end a demand. It also recognizes which demands in
the bookkeeping the rule has made, so that a restart of the detector changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

from demandops.detection.rules.rule_template import Values, candidates, filled, names, texts
from demandops.settings import API_VERSION

Action = Literal["demand", "deployment_request"]


@dataclass(frozen=True, slots=True)
class Goal:
    action: Action
    data: Mapping[str, Any]

    @property
    def id(self) -> str:
        """The id by which people know the goal: the demand's, or the request's."""
        return str(self.data["demand" if self.action == "demand" else "id"])

    @property
    def requesters(self) -> tuple[str, ...]:
        return tuple(sorted({*requesters_in(self.action, self.data)}))

    @property
    def action_name(self) -> str:
        """The action's type in ROS: ``Demand`` or ``DeploymentRequest``."""
        return "Demand" if self.action == "demand" else "DeploymentRequest"

    @property
    def document(self) -> Mapping[str, Any]:
        """The goal in the form that a file for ``demandops request`` has."""
        head = {"apiVersion": API_VERSION, "kind": "Demand"} if self.action == "demand" else {}
        return {**head, **self.data}

    def ended(self) -> Goal:
        if self.action == "deployment_request":
            return Goal(self.action, {**self.data, "shutdown": True})
        kept = {name: self.data[name] for name in ("demand", "requesters")}
        return Goal(self.action, {**kept, "operation": "release"})

    def renewed(self) -> Goal:
        if self.action == "deployment_request":
            return self  # the same request again renews the leases of its claims
        kept = {name: self.data[name] for name in ("demand", "requesters")}
        return Goal(self.action, {**kept, "operation": "renew"})


@dataclass(frozen=True, slots=True)
class BookedDemand:
    """A demand that the bookkeeping lists.

    ``demand`` is the demand's id. It is empty for a demand by ``DeploymentRequest``, of which
    ``request`` is the id.
    """

    demand: str
    request: str
    requesters: tuple[str, ...]


@dataclass(frozen=True)
class RuleDemand:
    action: Action
    data: Mapping[str, Any]

    def goal(self, values: Values) -> Goal:
        return Goal(self.action, filled(self.data, values))

    def names(self) -> set[str]:
        return {name for _, text in texts(self.data, "") for name in names(text)}

    def outline(self, values: Values) -> Goal:
        """Return the goal that starts the demand, if ``values`` has all names of the template.

        If ``values`` lacks a name, the template must be that of a ``Demand``. The goal then has
        only the demand's id and its requesters, which suffice to end the demand.
        """
        if self.names() <= set(values):
            return self.goal(values)
        kept = {name: self.data[name] for name in ("demand", "requesters")}
        return Goal(self.action, filled(kept, values))

    def subjects_of(
        self, held: BookedDemand, subjects: tuple[str, ...], rule: str
    ) -> Values | None:
        """Return the entities of the event for which the rule made a booked demand.

        ``subjects`` are the names by which the template refers to the event's entities. ``rule`` is
        the name of the rule. Return ``None`` if the rule makes no demand with this id and these
        requesters.
        """
        named = {*requesters_in(self.action, self.data)}
        is_own, held_id = self.action == "demand", held.demand or held.request
        if len(held.requesters) > len(named) or is_own != bool(held.demand):
            return None
        # The id alone may not tell the entities: ``{entity}-{other}`` can give ``a-b-c`` in two
        # ways. So the requesters are read as well, and each combination is tried.
        pairs = [(str(self.data["demand"] if is_own else self.data.get("id", "")), held_id)]
        pairs += product(sorted(named), held.requesters)
        entities: dict[str, set[str]] = {name: set() for name in subjects}
        for template, text in pairs:
            for name, entity in candidates(template, text).items():
                entities.get(name, set()).add(entity)
        for combination in product(*(sorted(entities[name]) for name in subjects)):
            values = dict(zip(subjects, combination, strict=True))
            goal = self.outline({"rule": rule, **values})
            if (goal.id, goal.requesters) == (held_id, tuple(sorted(held.requesters))):
                return values
        return None


def requesters_in(action: Action, data: Mapping[str, Any]) -> Iterator[str]:
    if action == "demand":
        yield from data.get("requesters", ())
        return
    for app in data.get("apps", ()):
        yield from app.get("object_detection_fusion_app", {}).get("requester_ids", ())
    for connection in data.get("connections", ()):
        yield from connection.get("requester_ids", ())
