"""The engine's state between two steps: who was seen where, and which events have not ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

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
    """An event that starts or ends: from now on its demand is wanted, or no longer wanted.

    ``values`` are for the rule's template. ``why`` explains to people what has happened.
    """

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
    """The dwell time before an event, or the event itself if it ``lasts``.

    ``since`` is the time at which the phase began.
    """

    since: float
    lasts: bool


@dataclass(frozen=True, slots=True)
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
    seen: Mapping[Who, Observation] = field(default_factory=dict)
    # The entities of resumed events that have not been seen since the engine started. Each has the
    # time at which it counts as gone.
    awaited: Mapping[Who, float] = field(default_factory=dict)
    # The phases that have not ended.
    phases: Mapping[Key, Phase] = field(default_factory=dict)
    # For each entity, the keys of the phases in which the entity takes part.
    engaged: Mapping[Who, frozenset[Key]] = field(default_factory=dict)
    # For each entity, the names of the rules with a count in whose radius the entity is.
    counted: Mapping[Who, frozenset[str]] = field(default_factory=dict)
    # How many entities a rule counts, by the name of the rule.
    counts: Mapping[str, int] = field(default_factory=dict)
    # The entities in each square, for rules on pairs.
    cells: Mapping[Cell, frozenset[str]] = field(default_factory=dict)

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
