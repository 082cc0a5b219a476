"""From a message to an observation: which entity, where it is, and which values it reports.

A message may be any object with attributes, so messages of rclpy and of a recorded bag are read
alike.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from math import isfinite
from typing import Any

from demandops.base.placeholders import VALUE
from demandops.detect.event_engine import Observation
from demandops.detect.rule_file import RuleFile

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
        self._place, self._map = definition.position, file.map
        self._position = self._place and (_getter(self._place.first), _getter(self._place.second))
        unavailable = self._place.unavailable if self._place else definition.unavailable
        self._unavailable = [(_getter(field), number) for field, number in unavailable.items()]
        thresholds = (rule.threshold for rule in file.rules)
        fields = {limits.field for limits in thresholds if limits and limits.source == source}
        self._fields = {field: _getter(field) for field in sorted(fields)}

    def observation(
        self,
        message: Any,  # noqa: ANN401
        entity: str,
        at: float,
    ) -> Observation | None:
        """Return what a message reports, ``None`` if it says that the position is not known.

        ``entity`` is from the topic, empty if a field has it.
        """
        for get, number in self._unavailable:
            if _number(get(message)) == number:
                return None
        if self._entity:
            entity = str(self._entity(message)).strip("/")
            if not re.fullmatch(VALUE, entity):
                raise Unreadable(f"{entity[:60]!r} is not a name of an entity")
        position = None
        if self._position and self._place:
            x, y = (_number(get(message)) for get in self._position)
            if self._map and self._place.in_degrees:
                x, y = self._metres(x * self._place.scale, y * self._place.scale)
            if abs(x) > _FARTHEST_M or abs(y) > _FARTHEST_M:
                raise Unreadable(f"the position is more than {_FARTHEST_M:g} m from the origin")
            position = x, y
        values = {field: _number(get(message)) for field, get in self._fields.items()}
        return Observation(self._source, entity, at, position, values)

    def _metres(self, latitude: float, longitude: float) -> tuple[float, float]:
        is_on_earth = abs(latitude) <= 90 and abs(longitude) <= 180
        metres = self._map.metres(latitude, longitude) if self._map and is_on_earth else None
        if metres is None:
            raise Unreadable(f"latitude {latitude:g}, longitude {longitude:g} is not on the map")
        return metres


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
