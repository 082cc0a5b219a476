"""What the engine knows: who was seen where, and how messages tell it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field, fields, replace
from math import isfinite
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

from demandops.detect.rule_file import RuleFile, is_entity

# ---- the engine's state between two steps: who was seen where, which events have not ended ----

# The identity of an event: its rule, and the entities that it is about.
Key: TypeAlias = tuple[str, tuple[str, ...]]

# The identity of an entity: its source and its name.
Who: TypeAlias = tuple[str, str]

# A square of the map, for one source of a rule on pairs: (rule, source, column, row).
Cell: TypeAlias = tuple[str, str, int, int]

_NOTHING: Mapping[Any, Any] = MappingProxyType({})


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
    # The entities in each square, for rules on pairs.
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


# ---- reads which entity a message is about, where the entity is, and which values it reports ----
#
# A message may be any object with attributes, so messages of rclpy and of a recorded bag are read
# alike.

_FARTHEST_M = 1e9
_PART = re.compile(r"(\w+)|\[(\d+)\]")

Getter = Callable[[Any], Any]


class Unreadable(Exception):
    """Raised for a message that cannot be used; the error's text is one line."""


class MessageReader:
    """Reads the messages of one source, and of these only the fields that rules need."""

    def __init__(self, file: RuleFile, source: str) -> None:
        definition = file.sources[source]
        self._source = source
        self._entity = definition.entity and _getter(definition.entity)
        self._position = definition.position and tuple(map(_getter, definition.position))
        thresholds = (rule.threshold for rule in file.rules)
        fields = {limits.field for limits in thresholds if limits and limits.source == source}
        self._fields = {field: _getter(field) for field in sorted(fields)}

    def observation(self, message: Any, entity: str, at: float) -> Observation:  # noqa: ANN401
        """Return what a message reports; ``entity`` is from the topic, empty if a field has it."""
        if self._entity:
            entity = str(self._entity(message)).strip("/")
            if not is_entity(entity):
                raise Unreadable(f"{entity[:60]!r} is not a name of an entity")
        position = None
        if self._position:
            x, y = (_number(get(message)) for get in self._position)
            if abs(x) > _FARTHEST_M or abs(y) > _FARTHEST_M:
                raise Unreadable(f"the position is more than {_FARTHEST_M:g} m from the origin")
            position = x, y
        values = {field: _number(get(message)) for field, get in self._fields.items()}
        return Observation(self._source, entity, at, position, values)


def _number(value: object) -> float:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise Unreadable(f"{str(value)[:60]!r} is not a number") from None
    if not isfinite(number):
        raise Unreadable(f"{number} is not a finite number")
    return number


def _getter(path: str) -> Getter:
    parts = [(name, int(index or 0)) for name, index in _PART.findall(path)]

    def get(message: Any) -> Any:  # noqa: ANN401
        value = message
        try:
            for name, index in parts:
                value = getattr(value, name) if name else value[index]
        except (AttributeError, IndexError, TypeError):
            raise Unreadable(f"the message has no field {path}") from None
        return value

    return get
