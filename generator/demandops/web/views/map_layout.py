"""The layout of the map: nodes are drawn at their positions, or by cluster and type."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from demandops.config.inventory import Node

WIDTH = 1200.0
HEAD = 30.0
_GAP = 14.0
_PLACE_HEIGHT = 640.0
_TYPES = ("cloud", "edge", "station", "vehicle")


@dataclass(frozen=True, slots=True)
class ServiceMark:
    name: str
    text: str
    tone: str
    is_lit: bool


@dataclass(frozen=True, slots=True)
class NodeCard:
    """A node as it is drawn.

    ``count`` is the number of all services on the node. ``services`` lists the services that the
    card shows, and ``more`` counts the services for which the card has no room. On a small card,
    ``services`` is empty and ``more`` is 0.
    """

    id: str
    type: str
    x: float
    y: float
    width: float
    height: float
    tone: str
    is_lit: bool
    is_drained: bool
    count: int
    label: str
    title: str
    services: tuple[ServiceMark, ...] = ()
    more: int = 0

    @property
    def middle(self) -> float:
        return self.x + self.width / 2


@dataclass(frozen=True, slots=True)
class Box:
    name: str
    x: float
    y: float
    width: float
    height: float


def by_cluster(
    cards: Mapping[str, NodeCard], nodes: Sequence[Node]
) -> tuple[dict[str, NodeCard], list[Box], float]:
    """Return the placed cards by node id, one box for each cluster, and the height of the map.

    The cards in a box are in rows, grouped by the type of the node.
    """
    clusters: dict[str, dict[str, list[NodeCard]]] = {}
    for node in sorted(nodes, key=lambda node: node.id):
        clusters.setdefault(node.cluster, {}).setdefault(node.type, []).append(cards[node.id])
    placed: dict[str, NodeCard] = {}
    boxes: list[Box] = []
    x = y = shelf = 0.0
    for name, groups in sorted(clusters.items()):
        inside, width, height = _box(groups, is_alone=len(clusters) == 1)
        if x and x + width > WIDTH:
            x, y, shelf = 0.0, y + shelf + _GAP, 0.0
        boxes.append(Box(name, x, y, width, height))
        placed |= {card.id: replace(card, x=card.x + x, y=card.y + y) for card in inside}
        x, shelf = x + width + _GAP, max(shelf, height)
    return placed, boxes, y + shelf


def _box(
    groups: Mapping[str, list[NodeCard]], *, is_alone: bool
) -> tuple[list[NodeCard], float, float]:
    """Return a cluster's cards, placed relative to its box, and the box's width and height."""
    first = next(iter(next(iter(groups.values()))))
    gap = 6.0 if first.width < 50 else _GAP
    room = 34.0 if first.services or first.width > 200 else gap
    total = sum(map(len, groups.values()))
    step = first.width + gap
    fitting = max(1, int((WIDTH - 2 * _GAP + gap) / step))
    widest = max(len(group) for group in groups.values())
    # about 2.5 times as many columns as rows, but at least 4
    columns = min(fitting, widest, max(4, math.ceil(math.sqrt(total * 2.5))))
    order = {name: place for place, name in enumerate(_TYPES)}
    width = WIDTH if is_alone else max(130.0, 2 * _GAP + step * columns - gap)
    placed, y = list[NodeCard](), HEAD
    sides = iter((0.0, *(1.0, -1.0) * len(groups)))
    for name in sorted(groups, key=lambda type: (order.get(type, len(order)), type)):
        group = groups[name]
        # short rows move to a side, so that lines between other types can pass them
        side = next(sides) if len(group) < columns else 0.0
        for start in range(0, len(group), columns):
            row = group[start : start + columns]
            free = (width - step * len(row) + gap) / 2
            left = free + side * min(step * 0.6, max(free - _GAP, 0.0))
            placed += [replace(card, x=left + step * n, y=y) for n, card in enumerate(row)]
            y += max(card.height for card in row) + gap
        y += room - gap
    return placed, width, y - room + _GAP


def by_place(
    cards: Mapping[str, NodeCard], nodes: Sequence[Node]
) -> tuple[dict[str, NodeCard], float]:
    """Return the placed cards by node id, and the height of the map.

    At least one node must have a position. A node is placed at its position, with north at the top,
    or below it if another card is there. The nodes without a position follow in rows below.
    """
    spots = {node.id: node.position for node in nodes if node.position}
    xs, ys = [spot.x for spot in spots.values()], [spot.y for spot in spots.values()]
    widest = max(cards[id].width for id in spots)
    # the same in both directions, so that distances on the map can be compared
    scale = min(
        (WIDTH - widest) / max(max(xs) - min(xs), 1.0),
        _PLACE_HEIGHT / max(max(ys) - min(ys), 1.0),
    )
    placed: dict[str, NodeCard] = {}
    for id, spot in sorted(spots.items(), key=lambda pair: (-pair[1].y, pair[1].x, pair[0])):
        x = (spot.x - min(xs)) * scale
        y = (max(ys) - spot.y) * scale
        card = replace(cards[id], x=x, y=y)
        # move it down until it overlaps no other card
        for other in sorted(placed.values(), key=lambda other: other.y):
            is_apart = (
                card.x + card.width + 4 <= other.x
                or other.x + other.width + 4 <= card.x
                or card.y + card.height + 4 <= other.y
                or other.y + other.height + 4 <= card.y
            )
            if not is_apart:
                card = replace(card, y=other.y + other.height + 6)
        placed[id] = card
    height = max(card.y + card.height for card in placed.values()) + _GAP
    x = row = 0.0
    without_position = (card for id, card in cards.items() if id not in spots)
    for card in sorted(without_position, key=lambda card: card.id):
        if x and x + card.width > WIDTH:
            x, height, row = 0.0, height + row + _GAP, 0.0
        placed[card.id] = replace(card, x=x, y=height)
        x, row = x + card.width + _GAP, max(row, card.height)
    return placed, height + row
