"""Reads which entity a message is about, where the entity is, and which values it reports.

A message may be any object with attributes, so messages of rclpy and of a recorded bag are read
alike.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from math import isfinite
from typing import Any

from demandops.detect.detection_state import Observation
from demandops.detect.rule_demand import is_entity
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
        self._position = definition.position and tuple(map(_getter, definition.position))
        thresholds = (rule.threshold for rule in file.rules)
        fields = {limits.field for limits in thresholds if limits and limits.source == source}
        self._fields = {field: _getter(field) for field in sorted(fields)}

    def observation(self, message: Any, entity: str, at: float) -> Observation:  # noqa: ANN401
        """Return what a message, which arrived at the time ``at``, reports.

        ``entity`` is the entity that the topic names; it is empty if a field of the message does.

        Raises:
            Unreadable: if a field is missing, a number is missing or not finite, a position is too
                far from the origin, or the entity's name has characters that are not allowed.
        """
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
