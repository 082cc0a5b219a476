"""The engine's state between two steps: who was seen where, and which events have not ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

Key: TypeAlias = tuple[str, tuple[str, ...]]
"""An event: its rule, and the entities that it is about."""

Who: TypeAlias = tuple[str, str]
"""An entity: its source and its name."""

Cell: TypeAlias = tuple[str, str, int, int]
"""A square of the map: the rule whose pairs are looked for, a source, and its place."""

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
    """The start or the end of an event: a demand is wanted from now on, or no longer.

    ``values`` fill in the rule's template. ``why`` says for people what has happened.
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
    """A condition that is met since ``since``; ``lasts`` is set after the dwell time."""

    since: float
    lasts: bool


@dataclass(frozen=True, slots=True)
class State:
    """The engine's whole state; times are in seconds since 1970.

    ``phases`` has the conditions that hold now; ``engaged`` lists their keys by entity.
    ``awaited`` has the entities of earlier events that were not seen since the start, each with the
    time at which it counts as gone. Until ``settled`` no count stops. ``counted`` are the rules
    that count an entity, ``counts`` how many entities each rule counts. ``cells`` has the entities
    by place, for pairs. Passing time alone changes nothing before ``due``, and no schedule before
    ``hours_due``.
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
        """Return the state after the clock was set forward by ``seconds``; negative: back."""
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
