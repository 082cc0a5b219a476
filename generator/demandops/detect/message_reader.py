"""From a message to an observation: which entity, where it is, and which values it reports.

A message may be any object with attributes, so messages of rclpy and of a recorded bag are read
alike.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from math import hypot, inf, isfinite
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

from demandops.base.placeholders import VALUE
from demandops.base.quoting import quoted
from demandops.detect.event_engine import Observation
from demandops.detect.rule_file import RuleFile
from demandops.model.config.base_model import seconds_of


class Unreadable(Exception):
    """Raised for a message that cannot be used; the error's text is one line."""


class NoTransform(Unreadable):
    """Raised for a position in a frame that nothing joins to the map's; the text names both."""


# ---- the tree of frames that ``/tf`` and ``/tf_static`` tell of ----
#
# A position is transformed by the newest transforms that were heard before it, so a recorded bag
# gives the positions that were heard live. Nothing is interpolated, and nothing waits.

TF_TYPE = "tf2_msgs/msg/TFMessage"
# By topic, whether its transforms hold until others replace them
TF_TOPICS = {"/tf": False, "/tf_static": True}

_Vector: TypeAlias = tuple[float, float, float]
# A tree of frames is seldom deeper than ten; a circle is not followed for longer.
_DEEPEST = 100
_MOST_FRAMES = 100_000


class _Link(NamedTuple):
    parent: str
    heard: float  # when; infinite if it is static
    moved: _Vector
    axis: _Vector  # the vector of the unit quaternion, and its real part
    real: float

    def turned(self, point: _Vector, real: float) -> _Vector:
        # p + 2 w (v × p) + 2 v × (v × p) for the quaternion (v, w)
        (a, b, c), (x, y, z) = self.axis, point
        i, j, k = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
        return (
            x + real * i + b * k - c * j,
            y + real * j + c * i - a * k,
            z + real * k + a * j - b * i,
        )

    def to_parent(self, point: _Vector) -> _Vector:
        x, y, z = self.turned(point, self.real)
        return x + self.moved[0], y + self.moved[1], z + self.moved[2]

    def to_child(self, point: _Vector) -> _Vector:
        x, y, z = (p - m for p, m in zip(point, self.moved, strict=True))
        return self.turned((x, y, z), -self.real)


class FrameTree:
    def __init__(self, map_frame: str) -> None:
        self.map_frame = map_frame
        self._links: dict[str, _Link] = {}

    def hear(self, message: Any, is_static: bool, at: float) -> None:  # noqa: ANN401
        for each in message.transforms:
            child, parent = (id.strip("/") for id in (each.child_frame_id, each.header.frame_id))
            by, turn = each.transform.translation, each.transform.rotation
            length = hypot(turn.x, turn.y, turn.z, turn.w)
            numbers = (by.x, by.y, by.z, length)
            is_known = child in self._links or len(self._links) < _MOST_FRAMES
            if length and all(map(isfinite, numbers)) and is_known:
                axis = turn.x / length, turn.y / length, turn.z / length
                heard = inf if is_static else at
                self._links[child] = _Link(parent, heard, (by.x, by.y, by.z), axis, turn.w / length)

    def on_map(self, frame: str, point: _Vector, since: float) -> _Vector:
        """Return a point of ``frame`` in the map's frame, by transforms heard from ``since`` on."""
        up, top = self._links_above(frame, since)
        down: list[_Link] = []
        if top != self.map_frame:  # perhaps the map is not the root, but below it as well
            down, root = self._links_above(self.map_frame, since)
            if top == root:
                top = self.map_frame
        if top != self.map_frame:
            raise NoTransform(
                f"positions in the frame {quoted(frame)} are left out, because nothing on "
                f"{' or '.join(TF_TOPICS)} leads from {quoted(top)} to {quoted(self.map_frame)}"
            )
        for link in up:
            point = link.to_parent(point)
        for link in reversed(down):
            point = link.to_child(point)
        return point

    def _links_above(self, frame: str, since: float) -> tuple[list[_Link], str]:
        links: list[_Link] = []
        while (link := self._links.get(frame)) and link.heard >= since and len(links) < _DEEPEST:
            links.append(link)
            frame = link.parent
            if frame == self.map_frame:
                break
        return links, frame


# ---- messages of one source ----

_FARTHEST_M = 1e9
_PART = re.compile(r"(\w+)|\[(\d+)\]")

Getter = Callable[[Any], Any]


class MessageReader:
    """Reads the messages of one source, and of these only the fields that rules need."""

    def __init__(self, file: RuleFile, source: str, frames: FrameTree | None = None) -> None:
        definition = file.sources[source]
        self._source = source
        self._entity = definition.entity and _getter(definition.entity)
        self._place, self._map = definition.position, file.map
        self._position = self._place and (_getter(self._place.first), _getter(self._place.second))
        self._frames, self._timeout_s = frames, seconds_of(definition.timeout)
        self._frame = self._place and self._place.frame and _getter(self._place.frame)
        self._height = self._place and self._place.z and _getter(self._place.z)
        silence = definition.silence.items()
        self._unavailable = [(_getter(field), numbers) for field, numbers in silence]
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
        for get, numbers in self._unavailable:
            if _number(get(message)) in numbers:
                return None
        if self._entity:
            entity = str(self._entity(message)).strip("/")
            if not re.fullmatch(VALUE, entity):
                raise Unreadable(f"{entity[:60]!r} is not a name of an entity")
        position = None
        if self._position and self._place:
            x, y = _number(self._position[0](message)), _number(self._position[1](message))
            if self._map and self._place.in_degrees:
                x, y = self._metres(x * self._place.scale, y * self._place.scale)
            elif self._frames and self._frame:
                frame = str(self._frame(message)).strip("/")
                if frame not in ("", self._frames.map_frame):
                    z = _number(self._height(message)) if self._height else 0.0
                    # what has not come for as long as an entity may be silent tells nothing
                    x, y, _ = self._frames.on_map(frame, (x, y, z), at - self._timeout_s)
            if not (abs(x) <= _FARTHEST_M and abs(y) <= _FARTHEST_M):
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

    def indexed(message: Any) -> Any:  # noqa: ANN401
        value = message
        for name, index in parts:
            value = getattr(value, name) if name else value[index]
        return value

    fetch = indexed if "[" in path else attrgetter(path)  # which is faster

    def get(message: Any) -> Any:  # noqa: ANN401
        try:
            value = fetch(message)
            # a `byte` is a text of one byte to rclpy, and a number in a bag
            return value[0] if isinstance(value, bytes) else value
        except (AttributeError, IndexError, TypeError):
            raise Unreadable(f"the message has no field {path}") from None

    return get
