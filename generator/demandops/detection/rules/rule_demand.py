"""What a rule demands: a template for goals of one of the two actions.

The template makes the goals that start, renew and end a demand. It also recognizes which demands in
the bookkeeping the rule has made.
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
    """A goal as plain data, and the action that takes it."""

    action: Action
    data: Mapping[str, Any]

    @property
    def id(self) -> str:
        """The id by which people know the goal: the demand's, or the request's."""
        return str(self.data["demand" if self.action == "demand" else "id"])

    @property
    def requesters(self) -> tuple[str, ...]:
        """All requesters that the goal names, sorted."""
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
        """Return the goal that ends the demand that this goal starts."""
        if self.action == "deployment_request":
            return Goal(self.action, {**self.data, "shutdown": True})
        kept = {name: self.data[name] for name in ("demand", "requesters")}
        return Goal(self.action, {**kept, "operation": "release"})

    def renewed(self) -> Goal:
        """Return the goal that renews the demand that this goal starts."""
        if self.action == "deployment_request":
            return self
        kept = {name: self.data[name] for name in ("demand", "requesters")}
        return Goal(self.action, {**kept, "operation": "renew"})


@dataclass(frozen=True, slots=True)
class BookedDemand:
    """A demand that the bookkeeping lists.

    ``demand`` is the demand's id. For a demand by ``DeploymentRequest``, it is empty, and
    ``request`` is the id of the request.
    """

    demand: str
    request: str
    requesters: tuple[str, ...]


@dataclass(frozen=True)
class RuleDemand:
    """The template of a rule's demand."""

    action: Action
    data: Mapping[str, Any]

    def goal(self, values: Values) -> Goal:
        """Return the goal that starts the demand."""
        return Goal(self.action, filled(self.data, values))

    def names(self) -> set[str]:
        """Return the names in braces that the template uses, such as ``entity``."""
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

    def _is(self, held: BookedDemand, values: Values) -> bool:
        goal, is_own = self.outline(values), self.action == "demand"
        if is_own != bool(held.demand):
            return False
        id = held.demand if is_own else held.request
        return (goal.id, goal.requesters) == (id, tuple(sorted(held.requesters)))

    def subjects_of(
        self, held: BookedDemand, subjects: tuple[str, ...], rule: str
    ) -> Values | None:
        """Return the entities of the event for which the rule made a booked demand.

        Args:
            held: the demand in the bookkeeping.
            subjects: the names by which the template refers to the event's entities.
            rule: the name of the rule.

        Returns:
            The entity for each name in ``subjects``. ``None`` if the rule makes no demand with this
            id and these requesters, or if the entities cannot be found. For example, the template
            ``{entity}-{other}`` can give the id ``a-b-c`` in two ways.
        """
        named = {*requesters_in(self.action, self.data)}
        if len(held.requesters) > len(named):
            return None
        if self.action == "demand":
            pairs = [(str(self.data["demand"]), held.demand)]
        else:
            pairs = [(str(self.data.get("id", "")), held.request)]
        pairs += product(sorted(named), held.requesters)
        found: dict[str, set[str]] = {name: set() for name in subjects}
        for template, text in pairs:
            for name, entity in candidates(template, text).items():
                found.get(name, set()).add(entity)
        for entities in product(*(sorted(found[name]) for name in subjects)):
            values = dict(zip(subjects, entities, strict=True))
            if self._is(held, {"rule": rule, **values}):
                return values
        return None


def requesters_in(action: Action, data: Mapping[str, Any]) -> Iterator[str]:
    """Yield the requesters that the data of a goal, or of its template, names."""
    if action == "demand":
        yield from data.get("requesters", ())
        return
    for app in data.get("apps", ()):
        yield from app.get("object_detection_fusion_app", {}).get("requester_ids", ())
    for connection in data.get("connections", ()):
        yield from connection.get("requester_ids", ())
