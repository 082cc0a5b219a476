"""The engine's state between two steps: who was seen where, and which events have not ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

Key: TypeAlias = tuple[str, tuple[str, ...]]
"""The identity of an event: its rule, and the entities that it is about."""

Who: TypeAlias = tuple[str, str]
"""The identity of an entity: its source and its name."""

Cell: TypeAlias = tuple[str, str, int, int]
"""A square of the map, for one source of a rule on pairs: (rule, source, column, row)."""

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
        """The entity with its source."""
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
        """The rule and the entities."""
        return self.rule, self.subjects


class Phase(NamedTuple):
    """The dwell time before an event (``lasts`` is false), or the event itself (``lasts`` is true).

    ``since`` is the time at which the phase began.
    """

    since: float
    lasts: bool


@dataclass(frozen=True, slots=True)
class State:
    """The engine's whole state; times are in seconds since 1970."""

    now: float
    due: float
    """The earliest time at which anything may change without an observation."""
    settled: float
    """Before this time, a low count ends no event."""
    hours_due: float
    """The time at which the schedules are checked next."""
    seen: Mapping[Who, Observation] = field(default_factory=dict)
    """The last observation of each entity that is not gone."""
    awaited: Mapping[Who, float] = field(default_factory=dict)
    """The entities of resumed events that have not been seen since the engine started.

    Each has the time at which it counts as gone.
    """
    phases: Mapping[Key, Phase] = field(default_factory=dict)
    """The phases that have not ended."""
    engaged: Mapping[Who, frozenset[Key]] = field(default_factory=dict)
    """For each entity, the keys of the phases in which the entity takes part."""
    counted: Mapping[Who, frozenset[str]] = field(default_factory=dict)
    """For each entity, the names of the rules that count it now.

    These rules have a condition on a count, and the entity is within its radius.
    """
    counts: Mapping[str, int] = field(default_factory=dict)
    """How many entities a rule counts, by the name of the rule."""
    cells: Mapping[Cell, frozenset[str]] = field(default_factory=dict)
    """The entities in each square, for rules on pairs."""

    @property
    def lasting(self) -> frozenset[Key]:
        """The events that have started and not stopped."""
        return frozenset(key for key, phase in self.phases.items() if phase.lasts)

    def shifted(self, seconds: float) -> State:
        """Return the state after the clock was set forward by ``seconds``.

        All times move with the clock, so dwell times and timeouts go on. Only schedules follow the
        new time: the next step looks at them.
        """
        return replace(
            self,
            now=self.now + seconds,
            settled=self.settled + seconds,
            due=min(self.due, self.now) + seconds,
            hours_due=self.now + seconds,
            seen={who: one._replace(at=one.at + seconds) for who, one in self.seen.items()},
            awaited={who: until + seconds for who, until in self.awaited.items()},
            phases={
                key: phase._replace(since=phase.since + seconds)
                for key, phase in self.phases.items()
            },
        )
