"""Point clouds of the objects around a sensor, and their conversion to and from messages."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterable, Iterator

from sensor_msgs.msg import PointCloud2, PointField

Point = tuple[float, float, float]

_POINT = struct.Struct("<fff")
_POINTS_PER_OBJECT = 40
_SPREAD_M = 0.4


def points_of(objects: Iterable[tuple[float, float]], chance: random.Random) -> list[Point]:
    """Return random points around the centre (x, y) of each object; objects are as big as cars."""
    return [
        (chance.gauss(x, _SPREAD_M), chance.gauss(y, _SPREAD_M), chance.uniform(0.2, 1.6))
        for x, y in objects
        for _ in range(_POINTS_PER_OBJECT)
    ]


def to_message(points: list[Point]) -> PointCloud2:
    """Return a cloud as a message in the frame `map`, without a stamp."""
    message = PointCloud2()
    message.header.frame_id = "map"
    message.height, message.width = 1, len(points)
    message.fields = [
        PointField(name=name, offset=4 * number, datatype=PointField.FLOAT32, count=1)
        for number, name in enumerate("xyz")
    ]
    message.point_step, message.row_step = _POINT.size, _POINT.size * len(points)
    message.is_dense = True
    message.data = b"".join(_POINT.pack(*point) for point in points)
    return message


def from_message(message: PointCloud2) -> Iterator[Point]:
    yield from _POINT.iter_unpack(bytes(message.data))
