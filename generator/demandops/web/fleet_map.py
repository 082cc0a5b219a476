"""The map: nodes and stacks of like nodes in rows, and the connections between them.

The server places everything, so the same state gives the same picture, and it is drawn without
scripts. A line runs only in the free space between rows and in the gaps between the cards of a row,
so none is behind a card.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from demandops.base.quoting import some
from demandops.model.config.inventory import Node
from demandops.model.release import ServiceRelease
from demandops.views.kinds import rows_of
from demandops.views.rows import RANKS, TONES, Filter, Row, exactly
from demandops.views.source import Source, word_of
from demandops.views.vocabulary import Json

# A drawing for wide screens and one for phones, of which the style sheet shows one: its width, the
# widths of its large and of its small cards, the least gap between them, and above how many nodes
# of a type these are drawn as stacks.
_DRAWINGS = {"wide": (1200.0, 212.0, 144.0, 20.0, 40), "narrow": (340.0, 156.0, 102.0, 8.0, 12)}
# The same for nodes that have nothing to do with what a filter finds.
_FEW_CARDS = 4
# Up to how many cards are large, so that they list releases by their names, and how many of these.
_MOST_LARGE, _MOST_LISTED = 16, 5
# Without a filter, more lines than this would say nothing; then only those not ready are drawn.
_MOST_LINES = 150
# By position, the map has so many columns and rows; nodes of one cell form a stack if there are
# too many to draw each.
_CELLS = 6
_CHANNEL = 44.0  # the free height between two rows of cards

_TYPES = ("cloud", "edge", "station", "vehicle")  # from top to bottom, other types below
_WORST_FIRST = ("bad", "busy", "none", "good", "empty")


@dataclass(frozen=True, slots=True)
class Mark:
    """A release on the card of a node, or a node on the card of a stack."""

    text: str
    tone: str
    is_service: bool
    is_lit: bool


def _tone(marks: Iterable[Mark]) -> str:
    return min((mark.tone for mark in marks), key=_WORST_FIRST.index, default="empty")


@dataclass(slots=True)
class Card:
    nodes: list[Node]
    is_lit: bool
    query: str  # the filter that chooses these nodes
    marks: list[Mark]
    tone: str
    x: float = 0.0
    y: float = 0.0
    width: float = 0.0
    height: float = 0.0
    row: int = 0
    is_large: bool = False

    @property
    def is_stack(self) -> bool:
        return len(self.nodes) > 1

    @property
    def is_drained(self) -> bool:
        return all(node.drained for node in self.nodes)

    @property
    def middle(self) -> float:
        return self.x + self.width / 2

    @property
    def bottom(self) -> float:
        return self.y + self.height

    @property
    def label(self) -> str:
        if not self.is_stack:
            return self.nodes[0].id
        types = {node.type for node in self.nodes}
        return f"{len(self.nodes)} {types.pop() if len(types) == 1 else 'node'}s"

    @property
    def state(self) -> str:
        late = sum(mark.tone in ("bad", "busy") for mark in self.marks)
        words = [f"{late} not ready"] if late else []
        words += [] if self.is_stack else [self.nodes[0].type]
        words += ["drained"] if self.is_drained else []
        words += ["unused"] if self.tone == "empty" else []
        return ", ".join(words)

    @property
    def title(self) -> str:
        releases = [] if self.is_stack else [f"{len(self.marks)} releases"]
        clusters = ", ".join(sorted({node.cluster for node in self.nodes}))
        return f"{self.label}: {', '.join([self.state, *releases, f'cluster {clusters}'])}"

    def short(self, text: str) -> str:
        most = int((self.width - 26) / 6.4)
        return text if len(text) <= most else f"{text[: most - 1]}…"


@dataclass(frozen=True, slots=True)
class Line:
    path: str
    tone: str
    is_lit: bool
    query: str
    title: str


def picture(source: Source, wanted: Filter, layout: str) -> dict[str, Any]:
    # A ``layout`` other than ``place`` and ``cluster`` means ``place`` if most nodes have a
    # position.
    known = source.nodes
    nodes = sorted(known.values(), key=lambda node: (node.cluster, node.id))
    spots = _spots(nodes)
    layouts = ("cluster", "place") if spots else ("cluster",)
    if layout not in layouts:
        layout = "place" if len(spots) > len(nodes) / 2 else "cluster"

    lit, lit_releases = set[str](), set[str]()  # a node is lit with a service or connection of it
    links, peers = list[tuple[Json, bool]](), defaultdict[str, set[str]](set)
    for row in rows_of(source, "connections"):
        if known.keys() >= {*(ends := row.item["nodes"])}:
            is_lit = bool(wanted) and wanted.matches(row)
            links.append((row.item, is_lit))
            peers[ends[0]].add(ends[1])
            peers[ends[1]].add(ends[0])
            if is_lit:
                lit.update(ends)
                lit_releases.update(row.item["releases"])
    for row in rows_of(source, "releases") if wanted else ():
        if wanted.matches(row):
            lit.add(row.item["node"])
            lit_releases.add(row.item["name"])
    marks: dict[str, list[Mark]] = {id: [] for id in known}
    for release in source.releases.values():
        if release.node.id not in marks:
            continue
        text = (
            " · ".join(filter(None, (release.key.service, release.key.source)))
            if isinstance(release, ServiceRelease)
            else f"{release.type.word} {', '.join(release.connections)}"
        )
        tone, is_lit = TONES[word_of(source.status(release.name))], release.name in lit_releases
        marks[release.node.id].append(Mark(text, tone, isinstance(release, ServiceRelease), is_lit))
    chosen = set[str]()
    for node in nodes if wanted else ():
        texts = {"node": [node.id], "type": [node.type], "cluster": [node.cluster]}
        around = {"peer": sorted(peers[node.id]) or ["none"]}
        around["cell"] = [_cell(spots[node.id])] if node.id in spots else []
        # a stack's filter names what is around its nodes; a word alone does not look there
        if wanted.matches(Row(texts | around)) and (
            wanted.matches(Row(texts)) or not wanted.matches(Row(around))
        ):
            chosen.add(node.id)
    lit = (lit | chosen) & known.keys()

    drawings = []
    for name, (width, large, small, gap, most) in _DRAWINGS.items():
        used_spots = spots if layout == "place" else {}
        cards = [*_cards(nodes, marks, peers, lit, used_spots, most)]
        drawing = Drawing(name, width, cards)
        drawing.place(large if len(drawing.cards) <= _MOST_LARGE else small, gap, peers, used_spots)
        drawing.connect(links, chosen, is_filtered=bool(wanted))
        drawings.append(drawing)
    return {
        "drawings": drawings,
        "total": len(nodes),
        "lit": len(lit),
        "has_stacks": any(card.is_stack for drawing in drawings for card in drawing.cards),
        "is_cut": drawings[0].is_cut,
        "layout": layout,
        "layouts": layouts,
        "is_dimmed": bool(wanted),
    }


# ---- which nodes stand together ----

# Where a node is on the map: from 0 to 1, from west to east and from north to south.
Spot = tuple[float, float]


def _spots(nodes: Iterable[Node]) -> dict[str, Spot]:
    positions = {node.id: node.position for node in nodes if node.position}
    xs, ys = ([getattr(each, axis) for each in positions.values()] or [0.0] for axis in "xy")
    # one scale for both directions, so that distances can be compared; the map is a wide one
    wide, high = max(xs) - min(xs), max(ys) - min(ys)
    span = max(wide, 2 * high, 1.0)
    left, top = min(xs) - (span - wide) / 2, max(ys) + (span / 2 - high) / 2
    return {
        id: ((each.x - left) / span, (top - each.y) / (span / 2)) for id, each in positions.items()
    }


def _step(part: float) -> int:
    return min(int(part * _CELLS), _CELLS - 1)


def _cell(spot: Spot) -> str:
    return "/".join(str(_step(part)) for part in spot)


def _cards(
    nodes: Iterable[Node],
    marks: Mapping[str, list[Mark]],
    peers: Mapping[str, set[str]],
    lit: set[str],
    spots: Mapping[str, Spot],
    most: int,
) -> Iterator[Card]:
    # If there are too many nodes of a type, those that are connected with the same nodes form a
    # stack: the vehicles of an edge. If there are still too many, those of a cluster do; else all
    # do. By position, those in one part of the map do.
    near = {peer for id in lit for peer in peers[id]}
    alike: dict[tuple[str, bool, bool, bool], list[Node]] = {}
    for node in nodes:
        kind = node.type, node.id in spots, node.id in lit, node.id in near
        alike.setdefault(kind, []).append(node)
    for (_, is_placed, *is_found), same in alike.items():
        # with a filter, nodes that have nothing to do with what it finds take little room
        is_aside = bool(lit) and not any(is_found) and sum(map(len, alike.values())) > most
        stacks: dict[str, list[Node]] = {exactly("node", node.id): [node] for node in same}
        for level in (2,) if is_placed else (3, 2, 1):
            if len(stacks) <= (_FEW_CARDS if is_aside else most):
                break
            stacks = {}
            for node in same:
                parts = [exactly("type", node.type), exactly("cluster", node.cluster)]
                parts += [exactly("peer", id) for id in sorted(peers[node.id]) or ["none"]]
                if is_placed:
                    parts[1] = exactly("cell", _cell(spots[node.id]))
                query = " ".join(parts[: level if level < 3 else None])
                stacks.setdefault(query, []).append(node)
        for query, stack in stacks.items():
            first, own = stack[0], marks[stack[0].id]
            if len(stack) > 1:
                own = [Mark(node.id, _tone(marks[node.id]), True, False) for node in stack]
            # where nothing is lit by itself, all is lit with the card
            is_some_lit = any(mark.is_lit for mark in own)
            own = sorted(
                (replace(mark, is_lit=mark.is_lit or not is_some_lit) for mark in own),
                key=lambda m: (not m.is_lit, _WORST_FIRST.index(m.tone), not m.is_service, m.text),
            )
            choice = query if len(stack) > 1 else exactly("node", first.id)
            yield Card(stack, first.id in lit, choice, own, _tone(own))


# ---- the drawing: where the cards stand, and the lines between them ----


@dataclass(slots=True)
class Gap:
    """A gap between the cards of a row, from top to bottom; lines go through it."""

    left: float
    right: float
    used: int = 0  # by how many lines


@dataclass(slots=True)
class Drawing:
    name: str
    width: float
    cards: list[Card]
    height: float = 0.0
    lines: list[Line] = field(default_factory=list)
    is_cut: bool = False  # lines are left out
    rows: list[tuple[float, float, list[Gap]]] = field(default_factory=list)  # top, bottom, gaps

    def place(
        self, across: float, gap: float, peers: Mapping[str, set[str]], spots: Mapping[str, Spot]
    ) -> None:
        by_row: dict[tuple[bool, int, str], list[Card]] = {}
        for card in self.cards:
            listed = min(len(card.marks), _MOST_LISTED + 1)
            card.is_large = len(self.cards) <= _MOST_LARGE and not card.is_stack
            card.width, card.height = across, 44.0 + 15.0 * listed if card.is_large else 58.0
            node = card.nodes[0]
            place = True, (*_TYPES, node.type).index(node.type), node.type
            if node.id in spots:
                place = False, _step(spots[node.id][1]), ""
            by_row.setdefault(place, []).append(card)
        columns = max(1, int((self.width - gap) // (across + gap)))
        middles: dict[str, float] = {}  # of the card of each node that is placed
        y = 6.0
        for (is_by_type, _, _), cards in sorted(by_row.items()):
            wishes: dict[int, float] = {}
            for card in cards:
                if is_by_type:  # below those that it is connected with, else on the right
                    above = [middles.get(id) for node in card.nodes for id in peers[node.id]]
                    near = [middle for middle in above if middle is not None] or [self.width]
                else:
                    near = [spots[node.id][0] * self.width for node in card.nodes]
                wishes[id(card)] = sum(near) / len(near)
            cards.sort(key=lambda c: (round(wishes[id(c)]), c.nodes[0].cluster, c.label))
            # A long row becomes several that all reach from left to right.
            parts = -(-len(cards) // columns)
            for row in (cards[part::parts] for part in range(parts)):
                free, left, right = (self.width - across * len(row)) / (len(row) + 1), gap, 0.0
                for number, card in enumerate(row):
                    even = free * (number + 1) + across * number
                    card.x = even if is_by_type else max(left, wishes[id(card)] - across / 2)
                    card.y, card.row, left = y, len(self.rows), card.x + across + gap
                right = self.width
                for card in reversed(row):  # back from the right edge
                    card.x = min(card.x, right - gap - across)
                    right = card.x
                middles |= {node.id: card.middle for card in row for node in card.nodes}
                edges = [0.0, *(edge for c in row for edge in (c.x, c.x + across)), self.width]
                gaps = [Gap(*sides) for sides in zip(edges[::2], edges[1::2], strict=True)]
                self.rows.append((y, max(card.bottom for card in row), gaps))
                y = self.rows[-1][1] + _CHANNEL
        self.height = y - _CHANNEL * 0.4

    def connect(
        self, links: Iterable[tuple[Json, bool]], chosen: set[str], *, is_filtered: bool
    ) -> None:
        # ``links`` are connections as rows, each with whether the filter finds it
        card_of = {node.id: card for card in self.cards for node in card.nodes}
        between: dict[tuple[int, int], tuple[Card, Card, list[tuple[Json, bool]]]] = {}
        for link in links:
            ends = (card_of[id] for id in link[0]["nodes"])
            upper, lower = sorted(ends, key=lambda card: (card.row, card.x))
            if upper is not lower:
                pair = between.setdefault((id(upper), id(lower)), (upper, lower, []))
                pair[2].append(link)
        for upper, lower, pairs in between.values():
            is_lit = any(found or not chosen.isdisjoint(link["nodes"]) for link, found in pairs)
            carried = [link for link, _ in pairs]
            worst = min((link["health"] or "unknown" for link in carried), key=RANKS.__getitem__)
            if is_filtered and not is_lit:
                continue
            is_late = TONES[worst] in ("bad", "busy")
            if len(between) > _MOST_LINES and not (is_lit or is_late):
                self.is_cut = True
                continue
            names = some([link["name"] for link in carried], 3)
            topics = sum(len(link["topics"]) for link in carried)
            title = f"{upper.label} and {lower.label}: {names}; {topics} topics; {worst}"
            singles = [card for card in (upper, lower) if not card.is_stack]
            query = " ".join(exactly("node", card.nodes[0].id) for card in singles)
            path = self._path(upper, lower)
            self.lines.append(Line(path, TONES[worst], is_lit, query, title))

    def _path(self, upper: Card, lower: Card) -> str:
        # it goes down through a gap between the cards of each row on its way
        x, y, end = upper.middle, self.rows[upper.row][1], lower.middle
        path = f"M{x:.1f} {upper.bottom:.1f}V{y:.1f}"
        if upper.row == lower.row:  # in an arc below both
            deep = y + _CHANNEL * 0.7
            path += f"C{x:.1f} {deep:.1f} {end:.1f} {deep:.1f} {end:.1f} {y:.1f}"
            return f"{path}V{lower.bottom:.1f}"
        for number in range(upper.row + 1, lower.row + 1):
            (top, bottom, gaps), to = self.rows[number], end
            if number < lower.row:
                straight = x + (end - x) / (lower.row - number + 1)
                gap = min(gaps, key=lambda gap: max(gap.left - straight, straight - gap.right))
                free = gap.right - gap.left
                if free > 40:
                    to = min(max(straight, gap.left + 8), gap.right - 8)
                else:  # lines through a narrow gap stand side by side
                    to = (gap.left + gap.right) / 2 + (gap.used % 5 - 2) * free / 8
                    gap.used += 1
            half = (y + top) / 2
            path += f"C{x:.1f} {half:.1f} {to:.1f} {half:.1f} {to:.1f} {top:.1f}"
            path += f"V{bottom:.1f}" if number < lower.row else ""
            x, y = to, bottom
        return path
