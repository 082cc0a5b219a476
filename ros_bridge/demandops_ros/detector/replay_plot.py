"""Draws a replay as a picture.

The upper part of the picture is a map with tracks and areas. In the lower part, each event, up to
the 200th, has a row that shows when the event lasted.
"""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from math import ceil, inf

from demandops.detection.events.detection_state import Key
from demandops.detection.rules.condition import Count, Near

from demandops_ros.detector.replay import Replay

_WIDTH, _MAP, _ROW, _LEFT, _RIGHT, _EDGE = 1000, 600, 22, 300, 30, 30
_COLORS = ("#0b6e99", "#c2410c", "#15803d", "#7e22ce", "#b91c1c", "#4d7c0f", "#be185d", "#1d4ed8")
_MOST_ROWS = 200
_STYLE = "font-family:sans-serif;font-size:12px"

Span = tuple[float, float]


def svg(replay: Replay) -> str:
    colors = _Colors()
    spans: dict[Key, list[Span]] = {}  # of each event; the end of one that lasts is inf
    for event, _ in replay.events:
        if event.starts:
            spans.setdefault(event.key, []).append((event.at, inf))
        else:
            spans[event.key][-1] = spans[event.key][-1][0], event.at
    rows = [*spans.items()][:_MOST_ROWS]
    height = _MAP + _ROW * (len(rows) + 3)
    parts = [*_map(replay, colors), *_times(replay, rows, colors)]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" style="{_STYLE}">'
        f'<rect width="{_WIDTH}" height="{height}" fill="white"/>\n{"".join(parts)}</svg>\n'
    )


class _Colors:
    def __init__(self) -> None:
        self._by_entity: dict[str, str] = {}

    def color(self, entity: str) -> str:
        next_color = _COLORS[len(self._by_entity) % len(_COLORS)]
        return self._by_entity.setdefault(entity, next_color)


class _Scale:
    """Converts positions in metres to positions in the picture, where y grows downwards."""

    def __init__(self, xs: list[float], ys: list[float]) -> None:
        self._x, self._y = min(xs, default=0.0), max(ys, default=0.0)
        width, height = max(xs, default=1.0) - self._x, self._y - min(ys, default=0.0)
        room = _WIDTH - 2 * _EDGE, _MAP - 2 * _EDGE
        self.factor = min(room[0] / (width or 1), room[1] / (height or 1))
        self.metres = _round(width or height or 1)

    def at(self, x: float, y: float) -> tuple[float, float]:
        return _EDGE + (x - self._x) * self.factor, _EDGE + (self._y - y) * self.factor


def _round(span: float) -> float:
    """Return the largest of 0.1, 0.2, 0.5, 1, 2 … up to a quarter of ``span``, or 0.1."""
    steps = [mantissa * 10.0**power for power in range(-1, 7) for mantissa in (1, 2, 5)]
    return max((step for step in steps if step <= span / 4), default=steps[0])


def _map(replay: Replay, colors: _Colors) -> Iterator[str]:
    areas = [
        (rule.name, rule.condition)
        for rule in replay.file.rules
        if isinstance(rule.condition, Near | Count)
    ]
    xs = [x for track in replay.tracks.values() for x, _ in track]
    ys = [y for track in replay.tracks.values() for _, y in track]
    for _, condition in areas:
        around = condition.stop if isinstance(condition, Near) else condition.radius
        low_x, low_y, high_x, high_y = condition.area.bounds
        xs += (low_x - around, high_x + around)
        ys += (low_y - around, high_y + around)
    scale = _Scale(xs, ys)
    labels: dict[tuple[float, float], list[str]] = {}
    for name, condition in areas:
        yield from _area(scale, condition)
        labels.setdefault(scale.at(*condition.area.corners[0]), []).append(name)
    for (x, y), names in labels.items():
        for line, name in enumerate(names):
            yield _text(x + 4, y + 14 * line, name, "#444")
    for (_, entity), track in replay.tracks.items():
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (scale.at(*point) for point in track))
        color = colors.color(entity)
        yield f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="2"/>\n'
        x, y = scale.at(*track[0])
        yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{color}"/>\n'
        yield _text(x + 6, y - 6, entity, color)
    length = scale.metres * scale.factor
    yield f'<path d="M{_EDGE} {_MAP - 12}h{length:.1f}" stroke="black" stroke-width="3"/>\n'
    yield _text(_EDGE, _MAP - 18, f"{scale.metres:g} m", "black")


def _area(scale: _Scale, condition: Near | Count) -> Iterator[str]:
    corners = [scale.at(*corner) for corner in condition.area.corners]
    x, y = corners[0]
    if len(corners) > 1:
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        yield f'<polygon points="{points}" fill="#0001" stroke="#666"/>\n'
    else:
        radii = (
            [condition.radius]
            if isinstance(condition, Count)
            else [condition.start, condition.stop]
        )
        for radius, dash in zip(radii, ("none", "6 4"), strict=False):
            yield (
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius * scale.factor:.1f}" '
                f'fill="#0001" stroke="#666" stroke-dasharray="{dash}"/>\n'
            )


def _times(replay: Replay, rows: list[tuple[Key, list[Span]]], colors: _Colors) -> Iterator[str]:
    start, end = replay.span
    factor = (_WIDTH - _LEFT - _RIGHT) / ((end - start) or 1)
    bottom = _MAP + _ROW * (len(rows) + 1)
    step = _round((end - start) or 1) / 2
    for tick in range(ceil((end - start) / step) + 1 if end > start else 1):
        x = _LEFT + tick * step * factor
        if x <= _WIDTH - _RIGHT:
            yield f'<path d="M{x:.1f} {_MAP}V{bottom}" stroke="#ddd"/>\n'
            yield _text(x, bottom + 14, f"{tick * step:g} s", "black")
    for number, ((rule, subjects), spans) in enumerate(rows, start=1):
        y = _MAP + _ROW * number
        color = colors.color(subjects[0]) if subjects else "#444"
        yield _text(_EDGE, y, f"{rule} {' '.join(subjects)}", "black")
        for since, until in spans:
            x, width = _LEFT + (since - start) * factor, (min(until, end) - since) * factor
            yield (
                f'<rect x="{x:.1f}" y="{y - 11}" width="{max(width, 1):.1f}" height="14" '
                f'fill="{color}"/>\n'
            )


def _text(x: float, y: float, text: str, color: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{color}">{escape(text)}</text>\n'
