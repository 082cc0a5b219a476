"""What a rule watches for: patterns of topics, and the conditions on what they report."""

from __future__ import annotations

import math
import re
from datetime import datetime, time, timedelta
from functools import cached_property
from typing import Annotated, Any, Literal
from zoneinfo import ZoneInfo

from pydantic import Field, field_validator, model_validator

from demandops.base.naming import topic_problem
from demandops.base.placeholders import values_in
from demandops.base.quoting import quoted
from demandops.model.config.base_model import CamelModel, DnsLabel, Positive, readable_by, without
from demandops.model.config.inventory import Position

# ---- patterns of topics, such as ``/vehicles/{entity}/pose`` ----

ENTITY = "{entity}"
_PART = "[A-Za-z0-9_]+"


def topic_pattern_problem(pattern: str) -> str:
    if pattern.count(ENTITY) > 1:
        return "has {entity} twice; name the entity once"
    example = pattern.replace(ENTITY, "entity")
    return topic_problem(example).replace(quoted(example), quoted(pattern), 1)


def entity_in(pattern: str, topic: str) -> str | None:
    """Return the entity that ``topic`` names, ``""`` if none, ``None`` if it does not match."""
    values = values_in(pattern, topic, _PART)
    return None if values is None else values.get("entity", "")


# ---- the conditions of rules: distances, counts, limits and hours ----
#
# A condition on a number has a value at which it starts and a value at which it stops. If both
# differ, a number that varies around one of them does not start and stop the condition again and
# again. Distances and thresholds may have one value for both.

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

    @cached_property
    def corners(self) -> tuple[tuple[float, float], ...]:
        # in metres, in the map frame; one, or at least three: an edge joins the last and the first
        corners = self.polygon or ((self.point,) if self.point else ())
        return tuple((corner.x, corner.y) for corner in corners)

    @property
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


def _refuse_distances(limits: Any) -> Any:  # noqa: ANN401 - one of the two conditions
    if limits.stop < limits.start:
        raise ValueError(
            f"'stop' is {limits.stop:g}, but must not be less than 'start', which is "
            f"{limits.start:g}: between the two, the condition stays as it is, so that an entity "
            "near the limit does not start and stop it again and again"
        )
    return limits


class Near(_InArea):
    """A condition that starts if an entity is at most ``start`` metres from an area.

    It stops if the entity is more than ``stop`` metres from the area.
    """

    start: Metres
    stop: Metres

    _has_hysteresis = model_validator(mode="after")(_refuse_distances)

    @property
    def reach(self) -> float:  # how far from the area an entity may matter
        return self.stop


class Together(CamelModel):
    """A condition that starts if two entities are at most ``start`` metres apart.

    It stops if they are more than ``stop`` metres apart.

    Both entities are of ``source``, unless ``other`` names the source of the second one.
    """

    source: DnsLabel
    other: DnsLabel | None = None
    start: Metres
    stop: Annotated[float, Field(ge=0.01, le=1e6)]

    _has_hysteresis = model_validator(mode="after")(_refuse_distances)


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

    @property
    def reach(self) -> float:
        return self.radius


class Threshold(CamelModel):
    """A condition that starts if a number is above ``above``, below ``below`` or in ``one_of``.

    It stops if the number is back at ``stop``, or has passed ``stop`` on its way back; with
    ``one_of``, such as the cause codes of a warning, if the number is another one.
    """

    source: DnsLabel
    field: FieldPath
    above: Number | None = None
    below: Number | None = None
    one_of: Annotated[tuple[Number, ...], Field(strict=False, min_length=1)] | None = None
    stop: Number | None = None

    @model_validator(mode="after")
    def _has_hysteresis(self) -> Threshold:
        if sum(each is not None for each in (self.above, self.below, self.one_of)) != 1:
            raise ValueError("must have exactly one of 'above', 'below' and 'oneOf'")
        if self.one_of is not None:
            if self.stop is not None:
                raise ValueError("'stop' belongs to 'above' and 'below'; leave it out")
            return self
        if self.stop is None:
            raise ValueError("'stop' is missing; add the number at which the condition ends")
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

    def is_past(self, value: float) -> bool:
        above, below = self.above, self.below
        if self.one_of is not None:
            return value in self.one_of
        return (above is not None and value > above) or (below is not None and value < below)

    def is_back(self, value: float) -> bool:
        if self.stop is None:
            return not self.is_past(value)
        return value <= self.stop if self.above is not None else value >= self.stop


def _clock(text: str) -> time:
    if not re.fullmatch(r"([01]\d|2[0-3]):[0-5]\d", text):
        raise ValueError(f"'{text}' is not a time of day; write it like \"07:30\", in quotes")
    return time.fromisoformat(text)


def _zone(text: str) -> ZoneInfo:
    try:
        return ZoneInfo(text)
    except (OSError, ValueError, KeyError):  # an unknown zone, or a text that cannot name a zone
        raise ValueError(f"'{text}' is not a time zone; write it like Europe/Berlin") from None


Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]
DAYS: tuple[Day, ...] = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")


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

    def is_on(self, now: float) -> bool:
        start, end = _clock(self.start), _clock(self.stop)
        local = datetime.fromtimestamp(now, _zone(self.zone))
        clock, weekday = local.time(), local.weekday()
        # the days are those on which a span starts, which may last past midnight
        today, yesterday = DAYS[weekday] in self.days, DAYS[weekday - 1] in self.days
        if start < end:
            return today and start <= clock < end
        return (today and clock >= start) or (yesterday and clock < end)

    def next_check(self, now: float) -> float:
        """Return the time after ``now`` at which to call :meth:`is_on` again."""
        zone = _zone(self.zone)
        today = datetime.fromtimestamp(now, zone).date()
        # The result of :meth:`is_on` changes at a start, at an end, and if summer time begins or
        # ends. To notice the latter soon, an hour is the longest time.
        moments = [
            datetime.combine(day, _clock(at), zone)
            for day in (today, today + timedelta(days=1))
            for at in (self.start, self.stop)
        ]
        ahead = (now + 3600.0, *(moment.timestamp() for moment in moments))
        return min(moment for moment in ahead if moment > now)
