"""An index of areas by position, so that an entity is compared only with the areas near it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from math import floor
from statistics import median
from typing import Generic, TypeVar

from demandops.detection.rules.area import Area

Item = TypeVar("Item")

_SMALLEST_CELL_M = 10.0
# How many squares an area in the index may touch. A larger area is compared with every entity.
_MOST_CELLS = 4096


class AreaGrid(Generic[Item]):
    """Items with areas, indexed by the squares of the map that each area and its margin touch."""

    def __init__(self, items: Iterable[tuple[Item, Area, float]]) -> None:
        """Build the index of (item, area, margin around the area in metres)."""
        boxes: list[tuple[Item, tuple[float, float, float, float]]] = []
        for item, area, around in items:
            low_x, low_y, high_x, high_y = area.bounds
            boxes.append((item, (low_x - around, low_y - around, high_x + around, high_y + around)))
        # With squares as wide as a usual area, an area touches few squares and a square few areas.
        sizes = [max(box[2] - box[0], box[3] - box[1]) for _, box in boxes]
        self._size = max(_SMALLEST_CELL_M, median(sizes) if sizes else 0.0)
        cells = defaultdict[tuple[int, int], list[Item]](list)
        large: list[Item] = []
        for item, box in boxes:
            left, bottom, right, top = (floor(edge / self._size) for edge in box)
            if (right - left + 1) * (top - bottom + 1) > _MOST_CELLS:
                large.append(item)
                continue
            for x in range(left, right + 1):
                for y in range(bottom, top + 1):
                    cells[x, y].append(item)
        self._large = tuple(large)
        self._cells = {cell: (*large, *inside) for cell, inside in cells.items()}

    def at(self, x: float, y: float) -> Sequence[Item]:
        """Return a superset of the items whose area or margin contains a position."""
        return self._cells.get((floor(x / self._size), floor(y / self._size)), self._large)
