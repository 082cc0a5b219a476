"""Areas of the map: a point or a polygon, and how far a position is from it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

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
            nearest = min(nearest, _to_edge(x, y, x1, y1, x2, y2))
            # each edge that a ray to the right crosses swaps inside and outside
            if (y1 > y) != (y2 > y) and x < x1 + (y - y1) / (y2 - y1) * (x2 - x1):
                inside = not inside
        return 0.0 if inside else nearest


def _to_edge(x: float, y: float, x1: float, y1: float, x2: float, y2: float) -> float:
    along_x, along_y = x2 - x1, y2 - y1
    length = along_x * along_x + along_y * along_y
    share = ((x - x1) * along_x + (y - y1) * along_y) / length if length else 0.0
    share = min(1.0, max(0.0, share))
    return math.hypot(x - x1 - share * along_x, y - y1 - share * along_y)
