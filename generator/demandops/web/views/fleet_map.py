"""The map: nodes with their services, and the connections between nodes.

Nodes are placed by position, or by cluster and type. The server computes the layout, so the same
state gives the same picture; the browser only draws it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

from demandops.config.inventory import Node
from demandops.plan.release import ServiceRelease
from demandops.web.situation import Situation
from demandops.web.views.filtered_table import Filter, Row
from demandops.web.views.health_word import RANKS, WORDS, word_of
from demandops.web.views.lists import rows_of
from demandops.web.views.map_layout import (
    HEAD,
    WIDTH,
    Box,
    NodeCard,
    ServiceMark,
    by_cluster,
    by_place,
)

_LINE = 15.0
_MOST_DETAILED, _MOST_NAMED, _MOST_NODES = 40, 250, 1_000
_MOST_SERVICES = 5
_MOST_LINES = 300


@dataclass(frozen=True, slots=True)
class Line:
    """The connections from one node to another, drawn as one line."""

    path: str
    tone: str
    is_lit: bool
    source: str
    target: str
    title: str


@dataclass(frozen=True, slots=True)
class Mass:
    """Many nodes or lines of one color, drawn together as one path."""

    tone: str
    path: str


@dataclass(frozen=True, slots=True)
class Picture:
    """The whole map. Nodes and lines that match the filter are lit."""

    width: float
    height: float
    boxes: tuple[Box, ...]
    # The nodes that are drawn one by one, with details.
    nodes: tuple[NodeCard, ...]
    # The lines that are drawn one by one.
    lines: tuple[Line, ...]
    # The other nodes, drawn as one shape for each color.
    many_nodes: tuple[Mass, ...]
    # The other lines, drawn as one shape for each color.
    many_lines: tuple[Mass, ...]
    # The number of all nodes.
    total: int
    # Whether only lit nodes are drawn.
    only_lit: bool
    layout: str
    layouts: tuple[str, ...]
    # Whether the parts that are not lit are drawn dimmed.
    is_dimmed: bool
    # The number of lit nodes.
    lit: int


@dataclass(slots=True)
class _Content:
    marks: list[ServiceMark] = field(default_factory=list)

    @property
    def tone(self) -> str:
        words = {"bad": 0, "busy": 1, "none": 2, "good": 3}
        return min((one.tone for one in self.marks), key=words.__getitem__, default="empty")


def picture(now: Situation, wanted: Filter, layout: str) -> Picture:
    """Return the map of a situation.

    Args:
        now: the situation to draw.
        wanted: the filter; services, connections and nodes that match are lit.
        layout: ``place`` or ``cluster``. Any other value means ``place`` if most nodes have a
            position, and ``cluster`` otherwise. If no node that is drawn has a position, nodes are
            always drawn by cluster.
    """
    config = now.commit_state.config
    nodes = list(config.nodes.values())
    content = _contents(now, wanted)
    total, placed = len(nodes), [node for node in nodes if node.position]
    layouts = ("cluster", "place") if placed else ("cluster",)
    if layout not in layouts:
        layout = "place" if len(placed) > len(nodes) / 2 else "cluster"
    lit = _lit_nodes(now, wanted, nodes, content)
    only_lit = len(nodes) > _MOST_NAMED and 0 < len(lit) <= _MOST_NAMED
    if only_lit:
        nodes = [node for node in nodes if node.id in lit]
    cards = {node.id: _card(node, content[node.id], node.id in lit, len(nodes)) for node in nodes}
    boxes: list[Box] = []
    if layout == "place" and any(node.position for node in nodes):
        cards, height = by_place(cards, nodes)
    else:
        cards, boxes, height = by_cluster(cards, nodes)
    drawn = list(cards.values())
    many, few = _apart(drawn, lambda one: one.is_lit, _MOST_NODES)
    masses = {tone: "".join(map(_square, each)) for tone, each in _by_tone(many)}
    more, lines = _apart(_lines(now, wanted, cards), lambda one: one.is_lit, _MOST_LINES)
    curves = {tone: "".join(line.path for line in each) for tone, each in _by_tone(more)}
    return Picture(
        WIDTH,
        height,
        tuple(boxes),
        tuple(few),
        tuple(lines),
        tuple(Mass(*each) for each in sorted(masses.items())),
        tuple(Mass(*each) for each in sorted(curves.items())),
        total,
        only_lit,
        layout,
        layouts,
        bool(wanted) and not only_lit,
        len(lit),
    )


_Drawn = TypeVar("_Drawn", "NodeCard", "Line")


def _apart(
    drawn: list[_Drawn], is_special: Callable[[_Drawn], bool], most: int
) -> tuple[list[_Drawn], list[_Drawn]]:
    """Return the parts to draw together, and the parts to draw one by one.

    No more than ``most`` parts are drawn one by one: if possible all parts, else if possible all
    special parts, else none.
    """
    if len(drawn) <= most:
        return [], drawn
    special = [one for one in drawn if is_special(one)]
    if len(special) > most:
        return drawn, []
    return [one for one in drawn if not is_special(one)], special


def _by_tone(drawn: Iterable[_Drawn]) -> Iterable[tuple[str, list[_Drawn]]]:
    found: dict[str, list[_Drawn]] = {}
    for one in drawn:
        found.setdefault(one.tone, []).append(one)
    return found.items()


def _square(card: NodeCard) -> str:
    return f"M{card.x:.0f} {card.y:.0f}h{card.width:.0f}v{card.height:.0f}h-{card.width:.0f}z"


def _lit_nodes(
    now: Situation, wanted: Filter, nodes: Iterable[Node], content: Mapping[str, _Content]
) -> set[str]:
    """Return the ids of nodes that match the filter, or have a service or connection that does."""
    if not wanted:
        return set()
    found = {id for id, each in content.items() if any(mark.is_lit for mark in each.marks)}
    for row in rows_of(now, "connections"):
        if wanted.matches(row):
            found.update(row.hidden["node"])
    for node in nodes:
        row = Row({}, {"node": [node.id], "type": [node.type], "cluster": [node.cluster]})
        if wanted.matches(row):
            found.add(node.id)
    return found & {*content}


def _contents(now: Situation, wanted: Filter) -> dict[str, _Content]:
    found = {id: _Content() for id in now.commit_state.config.nodes}
    lit = _lit_services(now, wanted)
    for release, _ in now.commit_state.targets:
        if isinstance(release, ServiceRelease) and release.node.id in found:
            word = word_of(now.status(release.name))
            of = release.key.source or ""
            text = f"{release.key.service} · {of}" if of else release.key.service
            found[release.node.id].marks.append(
                ServiceMark(release.name, text, WORDS[word], release.name in lit)
            )
    return found


def _lit_services(now: Situation, wanted: Filter) -> set[str]:
    if not wanted:
        return set()
    rows = rows_of(now, "services")
    return {row.cells["release"].parts[0].text for row in rows if wanted.matches(row)}


def _card(node: Node, content: _Content, is_lit: bool, total: int) -> NodeCard:
    marks = sorted(content.marks, key=lambda one: (not one.is_lit, one.text))
    title = f"{node.id}, {node.type} in {node.cluster}: {len(marks)} services"
    if node.drained:
        title += ", drained"
    card = NodeCard(
        node.id, node.type, 0, 0, 14, 14, content.tone, is_lit, node.drained, len(marks), "", title
    )
    if total > _MOST_NAMED:
        return card
    if total > _MOST_DETAILED:
        return replace(card, width=104, height=24, label=_short(node.id, 13))
    shown = tuple(replace(one, text=_short(one.text, 29)) for one in marks[:_MOST_SERVICES])
    more = len(marks) - len(shown)
    height = HEAD + _LINE * (len(shown) + bool(more)) + (6 if shown else 0)
    return replace(
        card, width=212, height=height, label=_short(node.id, 22), services=shown, more=more
    )


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"


def _lines(now: Situation, wanted: Filter, cards: Mapping[str, NodeCard]) -> list[Line]:
    """Return a line for each source and target that are drawn; lit lines come last, on top."""
    pairs: dict[tuple[str, str], list[Row]] = {}
    for row in rows_of(now, "connections"):
        ends = row.hidden["node"]
        if all(end in cards for end in ends):
            pairs.setdefault((ends[0], ends[1]), []).append(row)
    lines = []
    for (source, target), rows in pairs.items():
        words = [row.cells["health"].parts[0].text for row in rows]
        worst = min(words, key=RANKS.__getitem__)
        topics = sum(len(row.cells["topic"].parts) for row in rows)
        names = ", ".join(row.cells["connection"].parts[0].text for row in rows[:3])
        title = f"{source} to {target}: {names}, {topics} topics, {worst}"
        is_lit = bool(wanted) and any(wanted.matches(row) for row in rows)
        path = _curve(cards[source], cards[target])
        lines.append(Line(path, WORDS[worst], is_lit, source, target, title))
    return sorted(lines, key=lambda one: (one.is_lit, one.source, one.target))


def _curve(one: NodeCard, other: NodeCard) -> str:
    if one.y + one.height <= other.y:
        start, end, bend = one.y + one.height, other.y, 1.0
    elif other.y + other.height <= one.y:
        start, end, bend = one.y, other.y + other.height, -1.0
    else:
        start, end, bend = one.y + one.height, other.y + other.height, 0.0
    reach = max(18.0, abs(end - start) / 2)
    first = start + (bend or 1.0) * reach
    second = end - bend * reach if bend else end + reach
    return (
        f"M{one.middle:.1f} {start:.1f}C{one.middle:.1f} {first:.1f} "
        f"{other.middle:.1f} {second:.1f} {other.middle:.1f} {end:.1f}"
    )
