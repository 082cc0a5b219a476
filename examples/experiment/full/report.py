"""The report of a run: one HTML page that contains its plots; pure functions.

The templates beside this module draw what the functions here compute.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from .checks import Check
from .outcome import STAGES, Outcome, quantiles, running, steps
from .participants import EGO_DATA
from .routes import FAR_M

_COLORS = ("#0b6e99", "#c2571a", "#4b8b3b", "#8a4fa3")
_WIDTH, _LEFT = 900, 150
_MOST_ROWS = 8
"""The timeline has rows for up to this many vehicles, and the map has their names."""
_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    trim_blocks=True,
    undefined=StrictUndefined,
)


def plots(outcome: Outcome) -> dict[str, str]:
    draw: Any = _TEMPLATES.get_template("plots.svg.j2").module
    return {
        "map": draw.map(**_map(outcome)),
        "timeline": draw.timeline(**_timeline(outcome)),
        "delays": draw.delays(_LEFT, list(_delays(outcome))),
    }


def page(outcome: Outcome, checks: Iterable[Check]) -> str:
    template = _TEMPLATES.get_template("report.html.j2")
    return template.render(outcome=outcome, checks=list(checks), plots=plots(outcome))


def _map(outcome: Outcome) -> dict[str, Any]:
    middles = [near.point for near in outcome.crossings or (outcome.near,)]
    west, north = min(x for x, _ in middles) - 1.1 * FAR_M, max(y for _, y in middles) + 1.1 * FAR_M
    size = 460.0
    scale = size / (max(x for x, _ in middles) + 1.1 * FAR_M - west)

    def place(x: float, y: float) -> tuple[float, float]:
        return (x - west) * scale, (north - y) * scale

    near, is_few = outcome.near, len(outcome.routes) <= _MOST_ROWS
    circles = [(near.start * scale, "none"), (near.stop * scale, "4 4")]
    crossings = [
        {"x": x, "y": y, "circles": circles, "start": f"{near.start:g} m", "station": station}
        for number, middle in enumerate(middles)
        for (x, y), station in [(place(*middle), f"station{number:02}")]
    ]
    driven: dict[str, list[tuple[float, float]]] = {}
    for pose in outcome.poses:
        driven.setdefault(pose.vehicle, []).append(place(pose.x, pose.y))
    ways = []
    for number, route in enumerate(outcome.routes):
        color, shift = _COLORS[number % len(_COLORS)], 4 * (number % len(_COLORS)) - 6
        places = dict.fromkeys(driven.get(route.vehicle, [])[::5])
        points = " ".join(f"{x + shift:.1f},{y + shift:.1f}" for x, y in places)
        name = f"{route.vehicle}, {route.label}" if is_few else ""
        ways.append({"points": points, "color": color, "name": name})
    return {"size": size, "crossings": crossings, "ways": ways}


def _timeline(outcome: Outcome) -> dict[str, Any]:
    seconds = outcome.over - outcome.set_off
    scale = (_WIDTH - _LEFT - 20) / seconds

    def x(at: float) -> float:
        return _LEFT + (min(max(at, outcome.set_off), outcome.over) - outcome.set_off) * scale

    vehicles = [route.vehicle for route in outcome.routes]
    rows = [
        {
            "vehicle": vehicle,
            "color": _COLORS[row % len(_COLORS)],
            "stays": [(x(begin), x(end)) for begin, end in _stays(outcome, vehicle)],
            "arrivals": [x(at) for at in outcome.arrivals.get(EGO_DATA.format(vehicle), ())[::2]],
        }
        for row, vehicle in enumerate(vehicles if len(vehicles) <= _MOST_ROWS else ())
    ]
    counts = list(running(outcome))
    most = max((count for _, count in counts), default=1)
    always = len({pod.service for pod in outcome.pods})
    base, unit = 24 * len(rows) + 150.0, 110.0 / max(most, always, 1)
    points = [(outcome.set_off, 0), *counts, (outcome.over, counts[-1][1] if counts else 0)]
    return {
        "left": _LEFT,
        "right": _WIDTH - 20,
        "rows": rows,
        "base": base,
        "path": "".join(f" H{x(at):.1f} V{base - count * unit:.1f}" for at, count in points),
        "always": always,
        "always_y": base - always * unit,
        "ticks": [(tick, _LEFT + tick * scale) for tick in range(0, int(seconds) + 1, 10)],
    }


def _stays(outcome: Outcome, vehicle: str) -> Iterator[tuple[float, float]]:
    begin = None
    for event in outcome.events:
        if event.vehicle == vehicle:
            if event.joins:
                begin = event.at
            elif begin is not None:
                yield begin, event.at
                begin = None


def _delays(outcome: Outcome) -> Iterator[dict[str, Any]]:
    rows = {}
    for joins, word in ((True, "joins"), (False, "leaves")):
        delays = [step.delays() for step in steps(outcome) if step.event.joins is joins]
        for stage in STAGES:
            if values := tuple(each[stage] for each in delays if stage in each):
                rows[f"{word}: to {stage}"] = values
    longest = max((value for values in rows.values() for value in values), default=1.0)
    scale = (_WIDTH - _LEFT - 160) / longest
    for name, values in rows.items():
        low, median, high = (_LEFT + value * scale for value in quantiles(values))
        yield {
            "name": name,
            "low": low,
            "median": median,
            "high": high,
            "events": [_LEFT + value * scale for value in values],
            "told": f"median {quantiles(values)[1]:.2f} s",
        }
