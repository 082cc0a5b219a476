"""Turns observations into events, by the rules of one file."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace
from functools import partial
from math import floor, hypot, inf
from statistics import median
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

from demandops.detect.condition import Count, Hours, Near, Threshold, Together
from demandops.detect.rule_file import Rule, RuleFile, Who
from demandops.model.config.base_model import seconds_of

# ---- the engine's state between two steps: who was seen where, which events have not ended ----

# The identity of an event: its rule, and the entities that it is about.
Key: TypeAlias = tuple[str, tuple[str, ...]]

# A square of the map, for one source of a rule on pairs: (rule, source, column, row).
Cell: TypeAlias = tuple[str, str, int, int]

_NOTHING: Mapping[Any, Any] = MappingProxyType({})
_NOBODY: frozenset[str] = frozenset()


class Observation(NamedTuple):
    """One message about an entity; ``values`` are the fields that thresholds read."""

    source: str
    entity: str
    at: float
    position: tuple[float, float] | None = None
    values: Mapping[str, float] = _NOTHING

    @property
    def who(self) -> Who:
        return self.source, self.entity


class Event(NamedTuple):
    """A demand is wanted from now on, or no longer; ``why`` is for people."""

    rule: str
    subjects: tuple[str, ...]
    starts: bool
    at: float
    why: str
    values: Mapping[str, str | float] = _NOTHING

    @property
    def key(self) -> Key:
        return self.rule, self.subjects


class Phase(NamedTuple):
    """The dwell time before an event, or the event itself if it ``lasts``."""

    since: float
    lasts: bool


@dataclass(slots=True)
class State:
    """The engine's whole state; times are in seconds since 1970."""

    now: float
    # The earliest time at which anything may change without an observation.
    due: float
    # Before this time, a low count ends no event, because entities report one after the other after
    # a start.
    settled: float
    # The time at which the schedules are checked next.
    hours_due: float
    # The last observation of each entity that is not gone.
    seen: dict[Who, Observation] = field(default_factory=dict)
    # The entities of resumed events that have not been seen since the engine started. Each has the
    # time at which it counts as gone.
    awaited: dict[Who, float] = field(default_factory=dict)
    # The phases that have not ended.
    phases: dict[Key, Phase] = field(default_factory=dict)
    # For each entity, the keys of the phases in which the entity takes part.
    engaged: dict[Who, frozenset[Key]] = field(default_factory=dict)
    # For each entity, the names of the rules with a count in whose radius the entity is.
    counted: dict[Who, frozenset[str]] = field(default_factory=dict)
    # How many entities a rule counts, by the name of the rule.
    counts: dict[str, int] = field(default_factory=dict)
    # The entities in and around each square, for rules on pairs.
    cells: dict[Cell, frozenset[str]] = field(default_factory=dict)

    def copied(self) -> State:
        # The values in the mappings are immutable. The copies cost little, because one step takes
        # many observations.
        own: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        return State(**{name: copy(value) for name, value in own.items()})

    @property
    def lasting(self) -> frozenset[Key]:
        return frozenset(key for key, phase in self.phases.items() if phase.lasts)

    def shifted(self, seconds: float) -> State:
        """Return the state after the clock was set forward by ``seconds``."""
        # All times move with the clock, so dwell times and timeouts go on. Only schedules follow
        # the new time: the next step looks at them.
        return replace(
            self,
            now=self.now + seconds,
            settled=self.settled + seconds,
            due=min(self.due, self.now) + seconds,
            hours_due=self.now + seconds,
            seen={who: last._replace(at=last.at + seconds) for who, last in self.seen.items()},
            awaited={who: until + seconds for who, until in self.awaited.items()},
            phases={
                key: phase._replace(since=phase.since + seconds)
                for key, phase in self.phases.items()
            },
        )


# ---- an index of pairs by position, so that an entity is compared only with those near it ----


def distance(last: Observation, other: Observation) -> float:
    assert last.position is not None and other.position is not None  # noqa: S101 - rules need them
    return hypot(last.position[0] - other.position[0], last.position[1] - other.position[1])


class Pairs:
    # The map is divided into squares as wide as the distance at which the condition stops. So all
    # partners of an entity are in the entity's square and the squares around it. An entity is noted
    # in all nine, because it seldom changes its square: one look then finds its partners.

    def __init__(self, rule: Rule, condition: Together) -> None:
        self.rule, self.condition = rule, condition
        self._first, self._second = rule.sources[0], rule.sources[-1]

    def key(self, who: Who, other: Who) -> Key:
        # A pair is one event, in whatever order its entities report.
        if self._first == self._second:
            return self.rule.name, (min(who[1], other[1]), max(who[1], other[1]))
        first, second = (who, other) if who[0] == self._first else (other, who)
        return self.rule.name, (first[1], second[1])

    def _cell(self, observation: Observation | None) -> Cell | None:
        if observation is None or observation.position is None:
            return None
        x, y = observation.position
        size = self.condition.stop
        return self.rule.name, observation.source, floor(x / size), floor(y / size)

    def move(
        self,
        cells: MutableMapping[Cell, frozenset[str]],
        entity: str,
        before: Observation | None,
        after: Observation | None,
    ) -> Cell | None:
        # An entity without an observation or without a position is in no square.
        left, entered = self._cell(before), self._cell(after)
        if left == entered:
            return entered
        around_left, around_entered = {*_nine(left)}, {*_nine(entered)}
        for cell in around_left - around_entered:
            cells[cell] -= {entity}
            if not cells[cell]:
                del cells[cell]
        for cell in around_entered - around_left:
            cells[cell] = cells.get(cell, frozenset()) | {entity}
        return entered

    def around(
        self, cells: Mapping[Cell, frozenset[str]], cell: Cell | None, seen: Observation
    ) -> list[Who]:
        """Return all entities that are near enough, and some that are too far away, in order."""
        if cell is None:
            return []
        source = self._second if seen.source == self._first else self._first
        if source != seen.source:
            cell = (cell[0], source, cell[2], cell[3])
        near = cells.get(cell)
        if not near or (len(near) == 1 and source == seen.source):  # alone
            return []
        return [(source, name) for name in sorted(near) if (source, name) != seen.who]


def _nine(cell: Cell | None) -> Iterator[Cell]:
    if cell is not None:
        name, source, at_x, at_y = cell
        for x in (at_x - 1, at_x, at_x + 1):
            for y in (at_y - 1, at_y, at_y + 1):
                yield name, source, x, y


# ---- an index of areas by position ----

_SMALLEST_CELL_M = 10.0
# How many squares an area in the index may touch. A larger area is compared with every entity.
_MOST_CELLS = 4096

# A rule, and its condition on an area
Area = tuple[Rule, Near | Count]


class AreaGrid:
    """Rules on areas, indexed by the squares of the map that each area and its margin touch."""

    def __init__(self, areas: Iterable[Area]) -> None:
        boxes: list[tuple[Area, tuple[float, float, float, float]]] = []
        for area in areas:
            (low_x, low_y, high_x, high_y), around = area[1].bounds, area[1].reach
            boxes.append((area, (low_x - around, low_y - around, high_x + around, high_y + around)))
        # With squares as wide as a usual area, an area touches few squares and a square few areas.
        sizes = [max(box[2] - box[0], box[3] - box[1]) for _, box in boxes]
        self._size = max(_SMALLEST_CELL_M, median(sizes) if sizes else 0.0)
        cells = defaultdict[tuple[int, int], list[Area]](list)
        large: list[Area] = []
        for area, box in boxes:
            left, bottom, right, top = (floor(edge / self._size) for edge in box)
            if (right - left + 1) * (top - bottom + 1) > _MOST_CELLS:
                large.append(area)
                continue
            for x in range(left, right + 1):
                for y in range(bottom, top + 1):
                    cells[x, y].append(area)
        self._large = tuple(large)
        self._cells = {cell: (*large, *inside) for cell, inside in cells.items()}

    def at(self, x: float, y: float) -> Sequence[Area]:
        # a superset of the rules whose area or margin contains the position
        return self._cells.get((floor(x / self._size), floor(y / self._size)), self._large)


# ---- the engine, which turns observations into events by the rules of one file ----
#
# ``step`` changes none of its arguments and reads no clock. The same observations give the same
# events, however they are split into steps.


class EventEngine:
    """The rules of a file, indexed by source and area; :meth:`step` applies them."""

    def __init__(self, file: RuleFile) -> None:
        self.rules = {rule.name: rule for rule in file.rules}
        self.timeouts = {
            name: float(seconds_of(source.timeout)) for name, source in file.sources.items()
        }
        self.hours: list[tuple[Rule, Hours]] = []
        self.thresholds: dict[str, list[tuple[Rule, Threshold]]] = defaultdict(list)
        self.pairs: dict[str, list[Pairs]] = defaultdict(list)
        areas = defaultdict[str, list[Area]](list)
        for rule in file.rules:
            match rule.condition:
                case Near() | Count() as area:
                    areas[area.source].append((rule, area))
                case Together() as together:
                    pairs = Pairs(rule, together)
                    for source in dict.fromkeys(rule.sources):
                        self.pairs[source].append(pairs)
                case Threshold() as limits:
                    self.thresholds[limits.source].append((rule, limits))
                case Hours() as hours:
                    self.hours.append((rule, hours))
        self.areas = {name: AreaGrid(areas[name]) for name in file.sources}
        # of the step that is made
        self._state, self._events = State(0.0, -inf, 0.0, 0.0), list[Event]()

    def start(self, now: float, held: Iterable[Key] = (), settle_s: float = 0.0) -> State:
        """Return the state with which the engine starts.

        ``held`` are the events whose demands are already booked. Their entities count as gone if
        they stay unseen for ``settle_s`` seconds, or for the timeout of their source if that is
        longer.
        """
        keys, settle = tuple(held), settle_s
        # A count is complete only when each of its entities had the time to report.
        for name, _ in keys:
            rule = self.rules.get(name)
            if rule is not None and isinstance(rule.condition, Count):
                settle = max(settle, self.timeouts[rule.sources[0]])
        self._state = State(now, due=-inf, settled=now + settle, hours_due=now)
        # Events that started before a restart; those that no rule is for are ignored.
        for key in keys:
            rule = self.rules.get(key[0])
            if rule is None or len(rule.subjects) != len(key[1]) or not rule.is_for(key[1]):
                continue
            self._enter(key, rule, Phase(now, lasts=True))
            for who in rule.entities_of(key[1]):
                # A source that reports seldom may not have reported yet when the detector settles.
                self._state.awaited[who] = now + max(settle_s, self.timeouts[who[0]])
        return self._state

    def step(
        self, state: State, observations: Iterable[Observation], now: float
    ) -> tuple[State, tuple[Event, ...]]:
        """Return the new state, and the events that observations and passing time cause.

        The observations are in the order in which they were made. One of a source that the file
        lacks is left out. One earlier than ``state.now`` counts as made then, and one later than
        ``now`` as made at ``now``.
        """
        self._state, self._events = state.copied(), []
        for observation in observations:
            if observation.source in self.timeouts:
                self._pass_time(min(observation.at, now))
                self._observe(observation)
        self._pass_time(now)
        return self._state, tuple(self._events)

    # ---- time ----

    def _pass_time(self, until: float) -> None:
        while until >= self._state.due:
            self._state.due = inf
            # In the order of their times, so a long silence gives the same events as short ones.
            for at, act in sorted(self._all_due(), key=lambda due: due[0]):
                # an action may have made another change due before
                if at > min(until, self._state.due):
                    break
                self._state.now = max(self._state.now, at)
                act()
            self._state.due = min((at for at, _ in self._all_due()), default=inf)
        self._state.now = max(self._state.now, until)

    def _all_due(self) -> Iterator[tuple[float, Callable[[], None]]]:
        for key, phase in self._state.phases.items():
            if not phase.lasts:
                at = phase.since + self.rules[key[0]].dwell_s
                yield at, partial(self._end_dwell, key, phase)
        if self.hours:
            yield self._state.hours_due, self._look_at_hours
        if self._state.now < self._state.settled:
            for rule in self.rules.values():
                if isinstance(rule.condition, Count):
                    yield self._state.settled, partial(self._count, rule.name, 0)
        timeouts = self.timeouts
        for who, last in self._state.seen.items():
            yield last.at + timeouts[last.source], partial(self._lose_silent, who, last)
        for who, until in self._state.awaited.items():
            yield until, partial(self._lose_awaited, who)

    def _end_dwell(self, key: Key, phase: Phase) -> None:
        # An action before this one may have ended the phase, or begun another.
        if self._state.phases.get(key) is phase:
            self._begin(key, self.rules[key[0]])

    def _look_at_hours(self) -> None:
        for rule, hours in self.hours:
            is_on = hours.is_on(self._state.now)
            self._latch((rule.name, ()), rule, is_on, not is_on)
        self._state.hours_due = min(hours.next_check(self._state.now) for _, hours in self.hours)
        self._state.due = min(self._state.due, self._state.hours_due)

    def _lose_silent(self, who: Who, last: Observation) -> None:
        if self._state.seen.get(who) is last:
            self._lose(who, f"{who[1]} has been silent for {self.timeouts[who[0]]:g} s")

    def _lose_awaited(self, who: Who) -> None:
        if self._state.awaited.pop(who, None) is not None:
            self._lose(who, f"{who[1]} has not been seen since the start")

    def _lose(self, who: Who, why: str) -> None:
        last = self._state.seen.pop(who, None)
        for key in sorted(self._state.engaged.get(who, ())):
            self._leave(key, self.rules[key[0]], why)
        for name in sorted(self._state.counted.pop(who, ())):
            self._count(name, -1)
        for pair in self.pairs[who[0]]:
            if pair.rule.takes(who):
                pair.move(self._state.cells, who[1], last, None)

    # ---- observations ----

    def _observe(self, observation: Observation) -> None:  # noqa: PLR0912
        state = self._state
        if observation.at != state.now:
            observation = observation._replace(at=state.now)
        source, entity, at, position, values = observation
        who = (source, entity)
        before = state.seen.get(who)
        state.seen[who] = observation
        if state.awaited:
            state.awaited.pop(who, None)
        state.due = min(state.due, at + self.timeouts[source])
        for rule, limits in self.thresholds[source]:
            value = values.get(limits.field)
            if value is not None and rule.takes(who):
                is_past, is_back = limits.is_past(value), limits.is_back(value)
                self._latch((rule.name, (entity,)), rule, is_past, is_back)
        if position is None:
            return
        x, y = position
        compared, counted = set[str](), frozenset[str]()
        for rule, area in self.areas[source].at(x, y):
            if not rule.takes(who):
                continue
            away = area.distance(x, y)
            if isinstance(area, Near):
                compared.add(rule.name)
                self._latch((rule.name, (entity,)), rule, away <= area.start, away > area.stop)
            elif away <= area.radius:
                counted |= {rule.name}
        # The index does not yield the areas that the entity has left, so their events end here.
        if engaged := state.engaged.get(who):
            for key in sorted(engaged):
                left = self.rules[key[0]]
                if isinstance(left.condition, Near) and key[0] not in compared:
                    self._latch(key, left, False, True)
        if counted != (counted_before := state.counted.get(who, _NOBODY)):
            state.counted[who] = counted
            for name in sorted(counted ^ counted_before):
                self._count(name, 1 if name in counted else -1)
        for pairs in self.pairs[source]:
            if pairs.rule.takes(who):
                cell = pairs.move(state.cells, entity, before, observation)
                self._compare_with_others(pairs, cell, observation)

    def _compare_with_others(
        self, pairs: Pairs, cell: Cell | None, observation: Observation
    ) -> None:
        who, compared = observation.who, set[Key]()
        rule, limits, state = pairs.rule, pairs.condition, self._state
        for other in pairs.around(state.cells, cell, observation):
            key, away = pairs.key(who, other), distance(observation, state.seen[other])
            compared.add(key)
            self._latch(key, rule, away <= limits.start, away > limits.stop)
        # The squares around do not have the partners that are far away, so their events end here. A
        # partner that is still awaited after a restart has no position yet.
        for key in sorted(state.engaged.get(who, ())):
            is_left = key[0] == rule.name and key not in compared
            if is_left and all(entity in state.seen for entity in rule.entities_of(key[1])):
                self._latch(key, rule, False, True)

    def _count(self, name: str, change: int) -> None:
        rule = self.rules[name]
        count = self._state.counts[name] = self._state.counts.get(name, 0) + change
        if isinstance(limits := rule.condition, Count):
            stops = count <= limits.stop and self._state.now >= self._state.settled
            self._latch((name, ()), rule, count >= limits.start, stops)

    # ---- events ----

    def _latch(self, key: Key, rule: Rule, starts: bool, stops: bool) -> None:
        phase = self._state.phases.get(key)
        if stops and phase is not None:
            self._leave(key, rule, "")
        elif starts and phase is None:
            if rule.dwell_s:
                self._enter(key, rule, Phase(self._state.now, lasts=False))
                self._state.due = min(self._state.due, self._state.now + rule.dwell_s)
            else:
                self._begin(key, rule)

    def _begin(self, key: Key, rule: Rule) -> None:
        self._enter(key, rule, Phase(self._state.now, lasts=True))
        self._report(key, rule, True, "")

    def _enter(self, key: Key, rule: Rule, phase: Phase) -> None:
        self._state.phases[key] = phase
        for who in rule.entities_of(key[1]):
            self._state.engaged[who] = self._state.engaged.get(who, frozenset()) | {key}

    def _leave(self, key: Key, rule: Rule, why: str) -> None:
        phase = self._state.phases.pop(key)
        for who in rule.entities_of(key[1]):
            self._state.engaged[who] -= {key}
            if not self._state.engaged[who]:
                del self._state.engaged[who]
        if phase.lasts:
            self._report(key, rule, False, why)

    def _report(self, key: Key, rule: Rule, starts: bool, why: str) -> None:
        if why:
            self._events.append(Event(*key, starts, self._state.now, why))
            return
        subjects = key[1]
        values: dict[str, str | float] = {"rule": rule.name}
        values |= dict(zip(rule.subjects, subjects, strict=True))
        entities = [self._state.seen[who] for who in rule.entities_of(subjects)]
        x, y = (entities[0].position if entities else None) or (0.0, 0.0)
        match rule.condition:
            case Threshold(field=field):
                values["value"] = value = entities[0].values.get(field, 0.0)
                why = f"{field} of {subjects[0]} is {value:g}"
            case Count():
                values["count"] = count = self._state.counts.get(rule.name, 0)
                why = f"{count} entities are in or near the area"
            case Near() as area:
                values |= {"x": x, "y": y, "distance": (away := area.distance(x, y))}
                why = f"{subjects[0]} is {away:.1f} m from the area"
            case Together():
                values |= {"x": x, "y": y, "distance": (away := distance(*entities))}
                why = f"{subjects[0]} and {subjects[1]} are {away:.1f} m apart"
            case Hours():
                why = "the hours of the schedule"
        self._events.append(Event(*key, starts, self._state.now, why, values))
