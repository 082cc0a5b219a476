"""The conditions of rules: distances, counts, limits and hours.

A condition on a number has a value at which it starts and a value at which it stops. If both
differ, a number that varies around one of them does not start and stop the condition again and
again. Only a threshold may have the same value for both.
"""

from __future__ import annotations

import re
from datetime import time
from typing import Annotated, Any, Literal
from zoneinfo import ZoneInfo

from pydantic import Field, field_validator, model_validator

from demandops.config.base_model import CamelModel, DnsLabel, Positive, readable_by, without
from demandops.config.inventory import Position
from demandops.detection.rules.area import Area
from demandops.detection.rules.schedule import DAYS, Schedule
from demandops.quoting import quoted

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

    days: Annotated[
        tuple[Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"], ...],
        Field(strict=False, min_length=1),
    ] = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
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
