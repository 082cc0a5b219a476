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
"""A square of the map, for a rule on pairs and one of its sources: rule, source, column and row."""

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
    """A condition that has been met since the time ``since``.

    ``lasts`` is false during the dwell time, and true after it.
    """

    since: float
    lasts: bool


@dataclass(frozen=True, slots=True)
class State:
    """The engine's whole state; times are in seconds since 1970.

    ``seen`` has the last observation of each entity that is not gone.

    ``phases`` has the conditions that are met now, by key. ``engaged`` has, for each entity, the
    keys of the conditions in which the entity takes part.

    ``awaited`` has the entities that take part in an earlier event and have not been seen since the
    start, each with the time at which the entity counts as gone. Before the time ``settled``, no
    condition on a count stops.

    ``counted`` has, for each entity, the rules that count it. ``counts`` has, for each rule, how
    many entities it counts. ``cells`` has the entities by square, for rules on pairs.

    Before the time ``due``, only an observation can change anything. Before the time
    ``hours_due``, no schedule begins or ends.
    """

    now: float
    due: float
    settled: float
    hours_due: float
    seen: Mapping[Who, Observation] = field(default_factory=dict)
    awaited: Mapping[Who, float] = field(default_factory=dict)
    phases: Mapping[Key, Phase] = field(default_factory=dict)
    engaged: Mapping[Who, frozenset[Key]] = field(default_factory=dict)
    counted: Mapping[Who, frozenset[str]] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    cells: Mapping[Cell, frozenset[str]] = field(default_factory=dict)

    @property
    def lasting(self) -> frozenset[Key]:
        """The events that have started and not stopped."""
        return frozenset(key for key, phase in self.phases.items() if phase.lasts)

    def shifted(self, seconds: float) -> State:
        """Return the state with all its times moved by ``seconds``."""
        return replace(
            self,
            now=self.now + seconds,
            settled=self.settled + seconds,
            due=self.due + seconds,
            hours_due=self.now + seconds,
            seen={who: one._replace(at=one.at + seconds) for who, one in self.seen.items()},
            awaited={who: until + seconds for who, until in self.awaited.items()},
            phases={
                key: phase._replace(since=phase.since + seconds)
                for key, phase in self.phases.items()
            },
        )
