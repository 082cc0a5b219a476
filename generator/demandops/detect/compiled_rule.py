"""Rules in a form that checks observations quickly; a rule's condition determines its class."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, MutableMapping
from fnmatch import translate
from math import floor, hypot
from typing import NamedTuple

from demandops.detect.condition import Count, Hours, Near, Threshold, Together
from demandops.detect.observations import Cell, Key, Observation, Who
from demandops.detect.rule_file import Rule, Values
from demandops.model.config.base_model import seconds_of

Seen = Mapping[Who, Observation]


class Facts(NamedTuple):
    """The values of an event for the rule's template, and the event's cause in words for people."""

    values: Values
    text: str


class CompiledRule:
    def __init__(self, rule: Rule) -> None:
        self.name, self.subjects, self.sources = rule.name, rule.subjects, rule.sources
        self.dwell = float(seconds_of(rule.dwell))
        # A bracket in a pattern stands for itself, but ``translate`` gives it a meaning.
        patterns = [pattern.replace("[", "[[]") for pattern in rule.entities]
        self._names = None if "*" in patterns else re.compile("|".join(map(translate, patterns)))

    def is_for(self, entity: str) -> bool:
        return self._names is None or self._names.match(entity) is not None

    def takes(self, who: Who) -> bool:
        return self.is_for(who[1])

    def entities_of(self, subjects: tuple[str, ...]) -> tuple[Who, ...]:
        # A rule on pairs from one source names this source once, but its events have two entities.
        return tuple(zip((*self.sources, *self.sources), subjects, strict=False))

    def facts(self, subjects: tuple[str, ...], seen: Seen, count: int) -> Facts:
        raise NotImplementedError

    def _named(self, subjects: tuple[str, ...]) -> dict[str, str | float]:
        return {"rule": self.name, **dict(zip(self.subjects, subjects, strict=True))}


class HoursRule(CompiledRule):
    def __init__(self, rule: Rule, hours: Hours) -> None:
        super().__init__(rule)
        self.schedule = hours.schedule

    def facts(self, subjects: tuple[str, ...], seen: Seen, count: int) -> Facts:
        return Facts(self._named(subjects), "the hours of the schedule")


class ThresholdRule(CompiledRule):
    def __init__(self, rule: Rule, limits: Threshold) -> None:
        super().__init__(rule)
        self.field, self._limits = limits.field, limits

    def starts(self, value: float) -> bool:
        above, below = self._limits.above, self._limits.below
        return (above is not None and value > above) or (below is not None and value < below)

    def stops(self, value: float) -> bool:
        is_low = value <= self._limits.stop
        return is_low if self._limits.above is not None else value >= self._limits.stop

    def facts(self, subjects: tuple[str, ...], seen: Seen, count: int) -> Facts:
        value = seen[self.sources[0], subjects[0]].values.get(self.field, 0.0)
        named = {**self._named(subjects), "value": value}
        return Facts(named, f"{self.field} of {subjects[0]} is {value:g}")


class AreaRule(CompiledRule):
    """A rule on one entity's distance to an area, or on the number of entities in or near it."""

    def __init__(self, rule: Rule, condition: Near | Count) -> None:
        super().__init__(rule)
        self.area = condition.area
        self.count = condition if isinstance(condition, Count) else None
        self.start: float = condition.radius if isinstance(condition, Count) else condition.start
        self.stop: float = condition.radius if isinstance(condition, Count) else condition.stop

    def facts(self, subjects: tuple[str, ...], seen: Seen, count: int) -> Facts:
        named = self._named(subjects)
        if self.count is not None:
            return Facts({**named, "count": count}, f"{count} entities are in or near the area")
        x, y = seen[self.sources[0], subjects[0]].position or (0.0, 0.0)
        distance = self.area.distance(x, y)
        text = f"{subjects[0]} is {distance:.1f} m from the area"
        return Facts({**named, "x": x, "y": y, "distance": distance}, text)


class PairRule(CompiledRule):
    # The map is divided into squares as wide as the distance at which the condition stops. So all
    # partners of an entity are in the entity's square and the squares around it, and an entity is
    # not compared with all others.

    def __init__(self, rule: Rule, condition: Together) -> None:
        super().__init__(rule)
        self.start, self.stop = condition.start, condition.stop
        self._first, self._second = self.sources[0], self.sources[-1]

    def takes(self, who: Who) -> bool:
        # The patterns of the rule limit only the entities of the first source.
        return who[0] != self._first or self.is_for(who[1])

    def key(self, who: Who, other: Who) -> Key:
        # A pair is one event, in whatever order its entities report.
        if self._first == self._second:
            return self.name, (min(who[1], other[1]), max(who[1], other[1]))
        return self.name, (who[1], other[1]) if who[0] == self._first else (other[1], who[1])

    def facts(self, subjects: tuple[str, ...], seen: Seen, count: int) -> Facts:
        last, other = (seen[who] for who in self.entities_of(subjects))
        (x, y), away = last.position or (0.0, 0.0), distance(last, other)
        text = f"{subjects[0]} and {subjects[1]} are {away:.1f} m apart"
        return Facts({**self._named(subjects), "x": x, "y": y, "distance": away}, text)

    def _cell(self, observation: Observation | None) -> Cell | None:
        if observation is None or observation.position is None:
            return None
        x, y = observation.position
        return self.name, observation.source, floor(x / self.stop), floor(y / self.stop)

    def move(
        self,
        cells: MutableMapping[Cell, frozenset[str]],
        entity: str,
        before: Observation | None,
        after: Observation | None,
    ) -> None:
        # An entity without an observation or without a position is in no square.
        left, entered = self._cell(before), self._cell(after)
        if left == entered:
            return
        if left is not None:
            cells[left] = cells[left] - {entity}
            if not cells[left]:
                del cells[left]
        if entered is not None:
            cells[entered] = cells.get(entered, frozenset()) | {entity}

    def around(self, cells: Mapping[Cell, frozenset[str]], seen: Observation) -> Iterator[Who]:
        """Yield all entities that are near enough, and some that are too far away."""
        cell = self._cell(seen)
        if cell is None:
            return
        source = self._second if seen.source == self._first else self._first
        _, _, at_x, at_y = cell
        for x in (at_x - 1, at_x, at_x + 1):
            for y in (at_y - 1, at_y, at_y + 1):
                for entity in cells.get((self.name, source, x, y), ()):
                    if (source, entity) != seen.who:
                        yield source, entity


def distance(last: Observation, other: Observation) -> float:
    assert last.position is not None and other.position is not None  # noqa: S101 - rules need them
    return hypot(last.position[0] - other.position[0], last.position[1] - other.position[1])


def compiled(rule: Rule) -> CompiledRule:
    condition = rule.condition
    if isinstance(condition, Near | Count):
        return AreaRule(rule, condition)
    if isinstance(condition, Together):
        return PairRule(rule, condition)
    if isinstance(condition, Threshold):
        return ThresholdRule(rule, condition)
    return HoursRule(rule, condition)
