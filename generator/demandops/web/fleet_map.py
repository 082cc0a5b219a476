"""The map: nodes with their services, and the connections between nodes."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from demandops.model.config.inventory import Node
from demandops.model.release import ServiceRelease
from demandops.views.kinds import rows_of
from demandops.views.rows import Filter, Row
from demandops.views.source import RANKS, WORDS, Source, word_of

# ---- the layout: nodes are drawn at their positions, or by cluster and type ----

WIDTH = 1200.0
HEAD = 30.0
_GAP = 14.0
_PLACE_HEIGHT = 640.0
_TYPES = ("cloud", "edge", "station", "vehicle")

# A cluster's name, and its x, y, width and height on the map.
Box = tuple[str, float, float, float, float]


@dataclass(frozen=True, slots=True)
class ServiceMark:
    name: str
    text: str
    tone: str
    is_lit: bool


@dataclass(frozen=True, slots=True)
class NodeCard:
    id: str
    type: str
    x: float
    y: float
    width: float
    height: float
    tone: str
    is_lit: bool
    is_drained: bool
    count: int  # of all services on the node
    label: str
    title: str
    services: tuple[ServiceMark, ...] = ()  # none on a small card
    more: int = 0  # how many services the card has no room for

    def curve_to(self, target: NodeCard) -> str:
        if self.y + self.height <= target.y:  # down
            start, end, bend = self.y + self.height, target.y, 1.0
        elif target.y + target.height <= self.y:  # up
            start, end, bend = self.y, target.y + target.height, -1.0
        else:  # between cards side by side, in an arc below both
            start, end, bend = self.y + self.height, target.y + target.height, 0.0
        reach = max(18.0, abs(end - start) / 2)
        first = start + (bend or 1.0) * reach
        second = end - bend * reach if bend else end + reach
        own, other = self.x + self.width / 2, target.x + target.width / 2
        return (
            f"M{own:.1f} {start:.1f}C{own:.1f} {first:.1f} "
            f"{other:.1f} {second:.1f} {other:.1f} {end:.1f}"
        )


def by_cluster(
    cards: Mapping[str, NodeCard], nodes: Sequence[Node]
) -> tuple[dict[str, NodeCard], list[Box], float]:
    """Return the placed cards by node id, one box for each cluster, and the height of the map."""
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
        boxes.append((name, x, y, width, height))
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
    # The placed cards by node id, and the height of the map. At least one node must have a
    # position. The nodes without one follow in rows below the others.
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
        y = (max(ys) - spot.y) * scale  # north is at the top
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


# ---- the picture, which the browser only draws, so the same state looks the same ----

_LINE = 15.0
# Up to how many nodes are drawn with their services, with their names only, and one by one.
_MOST_DETAILED, _MOST_NAMED, _MOST_NODES = 40, 250, 1_000
_MOST_SERVICES = 5
_MOST_LINES = 300


@dataclass(frozen=True, slots=True)
class Line:
    path: str
    tone: str
    is_lit: bool
    source: str
    target: str
    title: str


def picture(now: Source, wanted: Filter, layout: str) -> dict[str, Any]:
    # A ``layout`` other than ``place`` and ``cluster`` means ``place`` if most nodes have a
    # position. If no drawn node has a position, nodes are drawn by cluster.
    config = now.config
    nodes = list(config.nodes.values())
    rows = rows_of(now, "services") if wanted else []
    lit_services = {row.item["name"] for row in rows if wanted.matches(row)}
    marks: dict[str, list[ServiceMark]] = {id: [] for id in config.nodes}
    for release, _ in now.targets:
        if isinstance(release, ServiceRelease) and release.node.id in marks:
            tone = WORDS[word_of(now.status(release.name))]
            source = release.key.source
            text = f"{release.key.service} · {source}" if source else release.key.service
            mark = ServiceMark(release.name, text, tone, release.name in lit_services)
            marks[release.node.id].append(mark)
    total, placed = len(nodes), [node for node in nodes if node.position]
    layouts = ("cluster", "place") if placed else ("cluster",)
    if layout not in layouts:
        layout = "place" if len(placed) > len(nodes) / 2 else "cluster"
    lit: set[str] = set()
    if wanted:
        # a node is also lit if it has a service or connection that matches
        lit = {id for id, on_node in marks.items() if any(mark.is_lit for mark in on_node)}
        for row in rows_of(now, "connections"):
            if wanted.matches(row):
                lit.update(row.item["nodes"])
        own = ({"node": [n.id], "type": [n.type], "cluster": [n.cluster]} for n in nodes)
        lit.update(texts["node"][0] for texts in own if wanted.matches(Row(texts)))
        lit &= marks.keys()
    only_lit = len(nodes) > _MOST_NAMED and 0 < len(lit) <= _MOST_NAMED
    if only_lit:
        nodes = [node for node in nodes if node.id in lit]
    cards = {node.id: _card(node, marks[node.id], node.id in lit, len(nodes)) for node in nodes}
    boxes: list[Box] = []
    if layout == "place" and any(node.position for node in nodes):
        cards, height = by_place(cards, nodes)
    else:
        cards, boxes, height = by_cluster(cards, nodes)
    many, few = _apart(list(cards.values()), _MOST_NODES)
    more, lines = _apart(_lines(now, wanted, cards), _MOST_LINES)
    # The path of all that is not drawn one by one, by color: a map of thousands of nodes stays
    # small.
    masses, curves = defaultdict[str, str](str), defaultdict[str, str](str)
    for card in many:
        across = f"{card.width:.0f}"
        masses[card.tone] += f"M{card.x:.0f} {card.y:.0f}h{across}v{card.height:.0f}h-{across}z"
    for line in more:
        curves[line.tone] += line.path
    return {
        "width": WIDTH,
        "height": height,
        "boxes": boxes,
        "nodes": few,
        "lines": lines,
        "many_nodes": sorted(masses.items()),
        "many_lines": sorted(curves.items()),
        "total": total,
        "only_lit": only_lit,
        "layout": layout,
        "layouts": layouts,
        "is_dimmed": bool(wanted) and not only_lit,
        "lit": len(lit),
    }


_Drawn = TypeVar("_Drawn", "NodeCard", "Line")


def _apart(drawn: list[_Drawn], most: int) -> tuple[list[_Drawn], list[_Drawn]]:
    """Return the parts to draw together, and at most ``most`` parts to draw one by one."""
    if len(drawn) <= most:
        return [], drawn
    lit = [part for part in drawn if part.is_lit]
    if len(lit) > most:
        return drawn, []
    return [part for part in drawn if not part.is_lit], lit


def _card(node: Node, marks: list[ServiceMark], is_lit: bool, total: int) -> NodeCard:
    marks = sorted(marks, key=lambda mark: (not mark.is_lit, mark.text))
    worst_first = ("bad", "busy", "none", "good")
    tone = min((mark.tone for mark in marks), key=worst_first.index, default="empty")
    title = f"{node.id}, {node.type} in {node.cluster}: {len(marks)} services"
    if node.drained:
        title += ", drained"
    card = NodeCard(
        node.id, node.type, 0, 0, 14, 14, tone, is_lit, node.drained, len(marks), "", title
    )
    if total > _MOST_NAMED:
        return card
    if total > _MOST_DETAILED:
        return replace(card, width=104, height=24, label=_short(node.id, 13))
    shown = tuple(replace(mark, text=_short(mark.text, 29)) for mark in marks[:_MOST_SERVICES])
    more = len(marks) - len(shown)
    height = HEAD + _LINE * (len(shown) + bool(more)) + (6 if shown else 0)
    return replace(
        card, width=212, height=height, label=_short(node.id, 22), services=shown, more=more
    )


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"


def _lines(now: Source, wanted: Filter, cards: Mapping[str, NodeCard]) -> list[Line]:
    # lit lines come last, on top
    pairs: dict[tuple[str, str], list[Row]] = {}
    for row in rows_of(now, "connections"):
        ends = row.item["nodes"]
        if all(end in cards for end in ends):
            pairs.setdefault((ends[0], ends[1]), []).append(row)
    lines = []
    for (source, target), rows in pairs.items():
        words = [row.item["health"] or "unknown" for row in rows]
        worst = min(words, key=RANKS.__getitem__)
        topics = sum(len(row.item["topics"]) for row in rows)
        names = ", ".join(row.item["name"] for row in rows[:3])
        title = f"{source} to {target}: {names}, {topics} topics, {worst}"
        is_lit = bool(wanted) and any(wanted.matches(row) for row in rows)
        path = cards[source].curve_to(cards[target])
        lines.append(Line(path, WORDS[worst], is_lit, source, target, title))
    return sorted(lines, key=lambda line: (line.is_lit, line.source, line.target))
