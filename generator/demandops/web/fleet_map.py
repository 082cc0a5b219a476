"""The map: nodes and stacks of like nodes in rows, and the connections between them.

The server places everything, so the same state gives the same picture, and it is drawn without
scripts. A line runs only in the free space between rows and in the gaps between the cards of a row,
so none is behind a card.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from demandops.model.config.inventory import Node
from demandops.model.release import ServiceRelease
from demandops.views.source import RANKS, WORDS, Source, word_of
from demandops.web.lists import Filter, Row, exactly, rows_of

# A drawing for wide screens and one for phones, of which the style sheet shows one: its width, and
# above how many nodes of a type these are drawn as stacks.
_DRAWINGS = {"wide": (1200.0, 40), "narrow": (340.0, 12)}
_TYPES = ("cloud", "edge", "station", "vehicle")
_WORST = ("bad", "busy", "none", "good", "empty")

# The same for nodes that have nothing to do with what a filter finds.
_FEW_CARDS = 4
# Up to how many cards are large enough to list services by their names.
_MOST_DETAILED = 16
_MOST_SERVICES = 5
# Without a filter, more lines than this would say nothing; then only those not ready are drawn.
_MOST_LINES = 150
# By position, the map has so many columns and rows; nodes of one cell form a stack if there are
# too many to draw each.
_CELLS = 6
_CHANNEL = 44.0  # the free height between two rows of cards
_LINE = 15.0


@dataclass(frozen=True, slots=True)
class Mark:
    """A release on a node's card, or a node on a stack's."""

    text: str
    tone: str
    is_main: bool  # no client of a connection
    is_lit: bool


def tone_of(marks: Iterable[Mark]) -> str:
    return min((mark.tone for mark in marks), key=_WORST.index, default="empty")


@dataclass(slots=True)
class Card:
    nodes: list[Node]
    is_lit: bool
    query: str  # the filter that chooses these nodes
    marks: list[Mark]
    x: float = 0.0
    y: float = 0.0
    width: float = 0.0
    height: float = 0.0
    row: int = 0
    is_detailed: bool = False

    @property
    def is_stack(self) -> bool:
        return len(self.nodes) > 1

    @property
    def tone(self) -> str:
        return tone_of(self.marks)

    @property
    def label(self) -> str:
        if not self.is_stack:
            return self.nodes[0].id
        types = {node.type for node in self.nodes}
        return f"{len(self.nodes)} {types.pop() if len(types) == 1 else 'node'}s"

    @property
    def is_drained(self) -> bool:
        return all(node.drained for node in self.nodes)

    @property
    def state(self) -> str:
        late = sum(mark.tone in ("bad", "busy") for mark in self.marks)
        words = [f"{late} not ready"] if late else []
        words += [] if self.is_stack else [self.nodes[0].type]
        words += ["drained"] if self.is_drained else []
        words += [] if any(mark.tone != "empty" for mark in self.marks) else ["unused"]
        return ", ".join(words)

    @property
    def title(self) -> str:
        clusters = ", ".join(sorted({node.cluster for node in self.nodes}))
        parts = [self.state, f"cluster {clusters}"]
        if not self.is_stack:
            parts.append(f"{len(self.marks)} releases")
        return f"{self.label}: {', '.join(filter(None, parts))}"

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


@dataclass(slots=True)
class Drawing:
    name: str
    width: float
    height: float = 0.0
    cards: list[Card] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    is_cut: bool = False  # lines are left out


def picture(source: Source, wanted: Filter, layout: str) -> dict[str, Any]:
    # A ``layout`` other than ``place`` and ``cluster`` means ``place`` if most nodes have a
    # position, and some are not in one row.
    config = source.config
    nodes = sorted(config.nodes.values(), key=lambda node: (node.cluster, node.id))
    layouts = ("cluster", "place") if any(node.position for node in nodes) else ("cluster",)
    if layout not in layouts:
        is_placed = sum(node.position is not None for node in nodes) > len(nodes) / 2
        layout = "place" if is_placed else "cluster"

    connections = [
        row
        for row in rows_of(source, "connections")
        if config.nodes.keys() >= {*row.hidden["node"]}
    ]
    peers: dict[str, set[str]] = defaultdict(set)
    for row in connections:
        one, other = row.hidden["node"]
        peers[one].add(other)
        peers[other].add(one)

    matching: list[Row] = []
    if wanted:
        matching = [*filter(wanted.matches, (*rows_of(source, "services"), *connections))]
    lit_releases = {part.text for row in matching for part in row.cells["release"].parts}
    marks: dict[str, list[Mark]] = {id: [] for id in config.nodes}
    for release, _ in source.targets:
        if release.node.id in marks:
            is_service = isinstance(release, ServiceRelease)
            if isinstance(release, ServiceRelease):
                text = " · ".join(filter(None, (release.key.service, release.key.source)))
            else:
                text = f"{release.type.word} {', '.join(release.connections)}"
            tone = WORDS[word_of(source.status(release.name))]
            mark = Mark(text, tone, is_service, release.name in lit_releases)
            marks[release.node.id].append(mark)

    spots = _spots(nodes)
    # a node is lit if it matches, or a service or connection that it has
    chosen, lit = set[str](), {id for row in matching for id in _nodes_of(row)}
    for node in nodes if wanted else ():
        texts = {"node": [node.id], "type": [node.type], "cluster": [node.cluster]}
        texts |= {"peer": sorted(peers[node.id]) or ["none"]}
        texts["cell"] = [_cell(spots[node.id])] if node.id in spots else []
        if wanted.matches(Row({}, texts)):
            chosen.add(node.id)
    lit = (lit | chosen) & marks.keys()

    if layout == "cluster":
        spots = {}
    drawings = []
    for name, (width, most) in _DRAWINGS.items():
        drawing = Drawing(name, width)
        drawing.cards = [
            _card(group, query, marks, lit)
            for group, query in _groups(nodes, peers, lit, spots, most)
        ]
        _place(drawing, peers, spots)
        _draw_lines(drawing, connections, chosen, matching, is_filtered=bool(wanted))
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


def _nodes_of(row: Row) -> Iterable[str]:
    return row.hidden.get("node") or [part.text for part in row.cells["node"].parts]


# ---- which nodes stand together ----

# Where a node is on the map: from 0 to 1, from west to east and from north to south.
Spot = tuple[float, float]


def _spots(nodes: Iterable[Node]) -> dict[str, Spot]:
    positions = {node.id: node.position for node in nodes if node.position}
    if not positions:
        return {}
    xs, ys = [each.x for each in positions.values()], [each.y for each in positions.values()]
    # one scale for both directions, so that distances can be compared; the map is a wide one
    wide, high = max(xs) - min(xs), max(ys) - min(ys)
    span = max(wide, 2 * high, 1.0)
    return {
        id: (
            (each.x - min(xs) + (span - wide) / 2) / span,
            (max(ys) - each.y + (span / 2 - high) / 2) / (span / 2),
        )
        for id, each in positions.items()
    }


def _cell(spot: Spot) -> str:
    return "/".join(str(min(int(part * _CELLS), _CELLS - 1)) for part in spot)


def _groups(
    nodes: list[Node],
    peers: Mapping[str, set[str]],
    lit: set[str],
    spots: Mapping[str, Spot],
    most: int,
) -> Iterable[tuple[list[Node], str]]:
    """Yield the nodes of each card, with the filter that chooses them.

    If there are too many nodes of a type, those that are connected with the same nodes form a
    stack: the vehicles of an edge. If there are still too many, those of a cluster do; else all do.
    """
    near = {peer for id in lit for peer in peers[id]}
    alike: dict[tuple[str, bool, bool], list[Node]] = {}
    for node in nodes:
        kind = "" if node.id in spots else node.type, node.id in lit, node.id in near
        alike.setdefault(kind, []).append(node)
    for (type, *is_chosen), same in alike.items():
        # with a filter, nodes that have nothing to do with what it finds may take little room
        is_aside = bool(lit) and not any(is_chosen) and len(nodes) > most
        stacks: dict[str, list[Node]] = {exactly("node", node.id): [node] for node in same}
        for level in (3, 2, 1) if type else (0,):
            if len(stacks) <= (_FEW_CARDS if is_aside else most):
                break
            stacks = {}
            for node in same:
                ids = sorted(peers[node.id]) or ["none"]
                joined = " ".join(exactly("peer", id) for id in ids)
                parts = (exactly("type", node.type), exactly("cluster", node.cluster), joined)
                query = " ".join(parts[:level]) or exactly("cell", _cell(spots[node.id]))
                stacks.setdefault(query, []).append(node)
        for query, stack in stacks.items():
            yield stack, exactly("node", stack[0].id) if len(stack) == 1 else query


def _card(nodes: list[Node], query: str, marks: Mapping[str, list[Mark]], lit: set[str]) -> Card:
    card = Card(nodes, nodes[0].id in lit, query, marks[nodes[0].id])
    if card.is_stack:
        card.marks = [Mark(id, tone_of(marks[id]), True, False) for id in (n.id for n in nodes)]
    # where nothing is lit by itself, all is lit with the card
    is_some_lit = any(mark.is_lit for mark in card.marks)
    card.marks = sorted(
        (replace(mark, is_lit=mark.is_lit or not is_some_lit) for mark in card.marks),
        key=lambda mark: (not mark.is_lit, _WORST.index(mark.tone), not mark.is_main, mark.text),
    )
    return card


# ---- where the cards stand ----


def _place(drawing: Drawing, peers: Mapping[str, set[str]], spots: Mapping[str, Spot]) -> None:
    cards, width = drawing.cards, drawing.width
    is_detailed = len(cards) <= _MOST_DETAILED
    is_wide = width > 600
    across = (212.0 if is_detailed else 144.0) if is_wide else (156.0 if is_detailed else 102.0)
    gap = 20.0 if is_wide else 8.0
    for card in cards:
        card.width, card.height, card.is_detailed = across, 58.0, is_detailed and not card.is_stack
        if card.is_detailed:
            lines = min(len(card.marks), _MOST_SERVICES) + (len(card.marks) > _MOST_SERVICES)
            card.height = 44.0 + _LINE * lines
    rows: dict[tuple[int, int, str], list[Card]] = {}
    for card in cards:
        kind = card.nodes[0].type
        place = _TYPES.index(kind) if kind in _TYPES else len(_TYPES)
        key = 1, place, kind
        if card.nodes[0].id in spots:
            key = 0, min(int(spots[card.nodes[0].id][1] * _CELLS), _CELLS - 1), ""
        rows.setdefault(key, []).append(card)
    columns = max(1, int((width - gap) // (across + gap)))
    middle: dict[str, float] = {}  # of the card of each node that is placed
    y, number = 4.0, 0
    for key, row in sorted(rows.items()):
        wishes: list[tuple[float, Card]] = []
        for card in row:
            if key[0] == 0:
                wish = sum(spots[node.id][0] for node in card.nodes) / len(card.nodes) * width
            else:  # below or above those that it is connected with
                near = [middle[id] for node in card.nodes for id in peers[node.id] if id in middle]
                wish = sum(near) / len(near) if near else width
            wishes.append((wish, card))
        wishes.sort(key=lambda pair: (round(pair[0]), pair[1].nodes[0].cluster, pair[1].label))
        # A long row becomes several that all reach from left to right.
        parts = -(-len(row) // columns)
        for part in range(parts):
            chosen = wishes[part::parts]
            free = (width - across * len(chosen)) / (len(chosen) + 1)
            end = gap - across
            for place, (wish, card) in enumerate(chosen):
                even = free * (place + 1) + across * place
                card.x = (
                    max(end + gap + across if place else gap, wish - across / 2)
                    if (key[0] == 0)
                    else even
                )
                end = card.x
                card.y, card.row = y, number
            limit = width - gap
            for _, card in reversed(chosen):  # back from the right edge
                card.x = min(card.x, limit - across)
                limit = card.x - gap
            middle |= {node.id: c.x + across / 2 for _, c in chosen for node in c.nodes}
            y += max(card.height for _, card in chosen) + _CHANNEL
            number += 1
    drawing.height = max(y - _CHANNEL * 0.4, _CHANNEL)


# ---- the lines between them ----


def _draw_lines(
    drawing: Drawing,
    connections: Iterable[Row],
    chosen: set[str],
    matching: Iterable[Row],
    *,
    is_filtered: bool,
) -> None:
    lit_rows = {id(row) for row in matching}
    card_of = {node.id: card for card in drawing.cards for node in card.nodes}
    between: dict[tuple[int, int], list[Row]] = {}
    ends: dict[tuple[int, int], tuple[Card, Card]] = {}
    for row in connections:
        pair = sorted(
            map(card_of.__getitem__, row.hidden["node"]), key=lambda card: (card.row, card.x)
        )
        if pair[0] is not pair[1]:
            key = id(pair[0]), id(pair[1])
            ends[key] = pair[0], pair[1]
            between.setdefault(key, []).append(row)
    rows: dict[int, list[Card]] = defaultdict(list)
    for card in drawing.cards:
        rows[card.row].append(card)
    used = Counter[tuple[int, float]]()
    for key, carried in between.items():
        upper, lower = ends[key]
        is_lit = any(
            id(row) in lit_rows or not chosen.isdisjoint(row.hidden["node"]) for row in carried
        )
        words = [row.cells["health"].parts[0].text for row in carried]
        worst = min(words, key=RANKS.__getitem__)
        is_late = WORDS[worst] in ("bad", "busy")
        if is_filtered and not is_lit:
            continue
        if len(between) > _MOST_LINES and not (is_lit or is_late):
            drawing.is_cut = True
            continue
        topics = sum(len(row.cells["topic"].parts) for row in carried)
        names = ", ".join(row.cells["connection"].parts[0].text for row in carried[:3])
        more = f" and {len(carried) - 3} more" if len(carried) > 3 else ""
        title = f"{upper.label} and {lower.label}: {names}{more}; {topics} topics; {worst}"
        query = " ".join(
            exactly("node", card.nodes[0].id) for card in (upper, lower) if not card.is_stack
        )
        path = _path(upper, lower, rows, drawing.width, used)
        drawing.lines.append(Line(path, WORDS[worst], is_lit, query, title))


def _path(
    upper: Card,
    lower: Card,
    rows: Mapping[int, list[Card]],
    width: float,
    used: Counter[tuple[int, float]],
) -> str:
    """Return a path that goes down through the gaps between the cards of each row on its way."""
    x, bottom = (
        upper.x + upper.width / 2,
        {number: max(card.y + card.height for card in row) for number, row in rows.items()},
    )
    end, y = lower.x + lower.width / 2, bottom[upper.row]
    path = f"M{x:.1f} {upper.y + upper.height:.1f}V{y:.1f}"
    if upper.row == lower.row:
        deep = y + _CHANNEL * 0.7
        path += f"C{x:.1f} {deep:.1f} {end:.1f} {deep:.1f} {end:.1f} {y:.1f}"
        return f"{path}V{lower.y + lower.height:.1f}"
    for number in range(upper.row + 1, lower.row + 1):
        row = sorted(rows[number], key=lambda card: card.x)
        top, to = row[0].y, end
        if number < lower.row:
            edges = [0.0, *(edge for card in row for edge in (card.x, card.x + card.width)), width]
            gaps = [(left, right) for left, right in zip(edges[::2], edges[1::2], strict=True)]
            wish = x + (end - x) / (lower.row - number + 1)
            left, right = min(gaps, key=lambda gap: abs(min(max(wish, gap[0]), gap[1]) - wish))
            free = right - left
            if free > 40:  # a wide gap: near to the straight way
                to = min(max(wish, left + 8), right - 8)
            else:  # lines through a narrow one stand side by side
                place = used[number, left] % 5 - 2
                used[number, left] += 1
                to = (left + right) / 2 + place * free / 8
        half = (y + top) / 2
        path += f"C{x:.1f} {half:.1f} {to:.1f} {half:.1f} {to:.1f} {top:.1f}"
        if number < lower.row:
            path += f"V{bottom[number]:.1f}"
        x, y = to, bottom[number]
    return path
