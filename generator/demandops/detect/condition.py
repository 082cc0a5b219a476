"""What a rule watches for: areas, hours, topics, and the conditions made of them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import datetime, time, timedelta, tzinfo
from functools import cached_property
from typing import Annotated, Any, Literal
from zoneinfo import ZoneInfo

from pydantic import Field, field_validator, model_validator

from demandops.base.naming import topic_problem
from demandops.base.quoting import quoted
from demandops.model.config.base_model import CamelModel, DnsLabel, Positive, readable_by, without
from demandops.model.config.inventory import Position

# ---- areas of the map: a point or a polygon, and how far a position is from it ----

# x and y in metres, in the map frame of the positions.
Point = tuple[float, float]


@dataclass(frozen=True)
class Area:
    """A point, or a polygon of at least three corners; an edge joins its last and first corner."""

    corners: tuple[Point, ...]

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        xs, ys = zip(*self.corners, strict=True)
        return min(xs), min(ys), max(xs), max(ys)

    def distance(self, x: float, y: float) -> float:
        """Return the metres from a position to the area; 0 inside a polygon and on its edge."""
        if len(self.corners) == 1:
            ((at_x, at_y),) = self.corners
            return math.hypot(x - at_x, y - at_y)
        edges = zip(self.corners, (*self.corners[1:], self.corners[0]), strict=True)
        nearest, inside = math.inf, False
        for (x1, y1), (x2, y2) in edges:
            along_x, along_y = x2 - x1, y2 - y1
            length = along_x * along_x + along_y * along_y
            share = ((x - x1) * along_x + (y - y1) * along_y) / length if length else 0.0
            share = min(1.0, max(0.0, share))
            to_edge = math.hypot(x - x1 - share * along_x, y - y1 - share * along_y)
            nearest = min(nearest, to_edge)
            # each edge that a ray to the right crosses swaps inside and outside
            if (y1 > y) != (y2 > y) and x < x1 + (y - y1) / (y2 - y1) * (x2 - x1):
                inside = not inside
        return 0.0 if inside else nearest


# ---- schedules: the days and hours at which a rule's demand is wanted ----

Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]
DAYS: tuple[Day, ...] = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")


@dataclass(frozen=True, slots=True)
class Schedule:
    """A span of hours on certain days of the week.

    If ``end`` is before ``start``, the span lasts past midnight. ``days`` are the days on which a
    span starts, as numbers; Monday is 0.
    """

    days: frozenset[int]
    start: time
    end: time
    zone: tzinfo

    def is_on(self, now: float) -> bool:
        local = datetime.fromtimestamp(now, self.zone)
        clock, today = local.time(), local.weekday()
        if self.start < self.end:
            return today in self.days and self.start <= clock < self.end
        yesterday = (today - 1) % 7
        return (today in self.days and clock >= self.start) or (
            yesterday in self.days and clock < self.end
        )

    def next_check(self, now: float) -> float:
        """Return the time after ``now`` at which to call :meth:`is_on` again."""
        local = datetime.fromtimestamp(now, self.zone)
        # The result of :meth:`is_on` changes at a start, at an end, and if summer time begins or
        # ends. To notice the latter soon, an hour is the longest time.
        dates = (local.date(), local.date() + timedelta(days=1))
        moments = [
            datetime.combine(day, at, self.zone) for day in dates for at in (self.start, self.end)
        ]
        ahead = (now + 3600.0, *(moment.timestamp() for moment in moments))
        return min(moment for moment in ahead if moment > now)


# ---- patterns of topics, such as ``/vehicles/{entity}/pose`` ----

ENTITY = "{entity}"
_PART = r"(?P<entity>[A-Za-z0-9_]+)"


def topic_pattern_problem(pattern: str) -> str:
    if pattern.count(ENTITY) > 1:
        return "has {entity} twice; name the entity once"
    example = pattern.replace(ENTITY, "entity")
    return topic_problem(example).replace(quoted(example), quoted(pattern), 1)


def entity_in(pattern: str, topic: str) -> str | None:
    """Return the entity that ``topic`` names, ``""`` if none, ``None`` if it does not match."""
    before, entity, after = pattern.partition(ENTITY)
    if not entity:
        return "" if topic == pattern else None
    matched = re.fullmatch(f"{re.escape(before)}{_PART}{re.escape(after)}", topic)
    return matched["entity"] if matched else None


# ---- the conditions of rules: distances, counts, limits and hours ----
#
# A condition on a number has a value at which it starts and a value at which it stops. If both
# differ, a number that varies around one of them does not start and stop the condition again and
# again. Only a threshold may have the same value for both.

_FIELD = re.compile(r"[A-Za-z]\w*(\[[0-9]{1,9}\])*(\.[A-Za-z]\w*(\[[0-9]{1,9}\])*)*")


def _field_problem(path: str) -> str:
    if _FIELD.fullmatch(path):
        return ""
    return f"{quoted(path)} is not a field; write it like pose.position.x or ranges[0]"


# A field of a message, such as ``pose.position.x`` or ``state.continuous_state[0]``.
FieldPath = Annotated[str, without(_field_problem)]

Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Metres = Annotated[float, Field(ge=0, le=1e6)]


class _InArea(CamelModel):
    """A condition on the distance to a point or a polygon."""

    source: DnsLabel
    point: Position | None = None
    polygon: Annotated[tuple[Position, ...], Field(strict=False, min_length=3)] | None = None

    @model_validator(mode="after")
    def _has_one_shape(self) -> _InArea:
        if (self.point is None) == (self.polygon is None):
            raise ValueError("needs exactly one of point and polygon")
        return self

    @property
    def area(self) -> Area:
        corners = self.polygon or ((self.point,) if self.point else ())
        return Area(tuple((corner.x, corner.y) for corner in corners))


def _refuse_distances(start: float, stop: float) -> None:
    if stop <= start:
        raise ValueError(
            f"'stop' is {stop:g}, but must be more than 'start', which is {start:g}: between the "
            "two, the condition stays as it is, so that an entity near the limit does not start "
            "and stop it again and again"
        )


class Near(_InArea):
    """A condition that starts if an entity is at most ``start`` metres from an area.

    It stops if the entity is more than ``stop`` metres from the area.
    """

    start: Metres
    stop: Metres

    @model_validator(mode="after")
    def _has_hysteresis(self) -> Near:
        _refuse_distances(self.start, self.stop)
        return self


class Together(CamelModel):
    """A condition that starts if two entities are at most ``start`` metres apart.

    It stops if they are more than ``stop`` metres apart.

    Both entities are of ``source``, unless ``other`` names the source of the second one.
    """

    source: DnsLabel
    other: DnsLabel | None = None
    start: Metres
    stop: Annotated[float, Field(ge=0.01, le=1e6)]

    @model_validator(mode="after")
    def _has_hysteresis(self) -> Together:
        _refuse_distances(self.start, self.stop)
        return self


class Count(_InArea):
    """A condition that starts with ``start`` or more entities and stops with ``stop`` or fewer.

    ``radius`` is the largest distance to the area, in metres, at which an entity is counted.
    """

    radius: Metres = 0.0
    start: Positive
    stop: Annotated[int, Field(ge=0)]

    @model_validator(mode="after")
    def _has_hysteresis(self) -> Count:
        if self.stop >= self.start:
            raise ValueError(
                f"'stop' is {self.stop}, but must be less than 'start', which is {self.start}"
            )
        if self.point is not None and not self.radius:
            raise ValueError(
                "needs a radius of more than 0, because no entity is exactly at a point"
            )
        return self


class Threshold(CamelModel):
    """A condition that starts if a number is above ``above``, or below ``below``.

    It stops if the number is back at ``stop``, or has passed ``stop`` on its way back.
    """

    source: DnsLabel
    field: FieldPath
    above: Number | None = None
    below: Number | None = None
    stop: Number

    @model_validator(mode="after")
    def _has_hysteresis(self) -> Threshold:
        if (self.above is None) == (self.below is None):
            raise ValueError("must have exactly one of 'above' and 'below'")
        if self.above is not None and self.stop > self.above:
            raise ValueError(
                f"'stop' is {self.stop:g}, but must not be more than 'above', which is "
                f"{self.above:g}"
            )
        if self.below is not None and self.stop < self.below:
            raise ValueError(
                f"'stop' is {self.stop:g}, but must not be less than 'below', which is "
                f"{self.below:g}"
            )
        return self


def _clock(text: str) -> time:
    if not re.fullmatch(r"([01]\d|2[0-3]):[0-5]\d", text):
        raise ValueError(f"'{text}' is not a time of day; write it like \"07:30\", in quotes")
    return time.fromisoformat(text)


def _zone(text: str) -> ZoneInfo:
    try:
        return ZoneInfo(text)
    except (OSError, ValueError, KeyError):  # an unknown zone, or a text that cannot name a zone
        raise ValueError(f"'{text}' is not a time zone; write it like Europe/Berlin") from None


class Hours(CamelModel):
    """A condition that holds from one time of day to another, on certain days of the week."""

    days: Annotated[tuple[Day, ...], Field(strict=False, min_length=1)] = DAYS
    start: Annotated[str, readable_by(_clock)]
    stop: Annotated[str, readable_by(_clock)]
    zone: Annotated[str, readable_by(_zone)] = "UTC"

    # A span that ends when it starts could be a whole day or nothing.
    @field_validator("stop")
    @classmethod
    def _is_another_time(cls, stop: str, info: Any) -> str:  # noqa: ANN401 - pydantic's
        if stop == info.data.get("start"):
            raise ValueError("must differ from start")
        return stop

    @property
    def schedule(self) -> Schedule:
        days = frozenset(DAYS.index(day) for day in self.days)
        return Schedule(days, _clock(self.start), _clock(self.stop), _zone(self.zone))
