"""The report of a run: one HTML page that contains its plots; pure functions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from html import escape

from .checks import Check
from .measures import STAGES, quantiles, running, steps
from .outcome import Outcome
from .participants import EGO_DATA
from .routes import FAR_M

_COLORS = ("#0b6e99", "#c2571a", "#4b8b3b", "#8a4fa3")
_WIDTH, _LEFT = 900, 150
_MOST_ROWS = 8
"""The timeline has rows for up to this many vehicles, and the map has their names."""
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 960px; margin: 2em auto; }
table { border-collapse: collapse; margin: 1em 0; } th, td { padding: .2em .9em .2em 0;
text-align: left; border-bottom: 1px solid #ddd; }
.ok { color: #2c7a2c; } .fault { color: #b00020; font-weight: bold; } svg { width: 100%; }
"""


_TIMELINE = (
    "A bar shows when the vehicle was within the rules' distance. A mark below a bar is a message "
    "with ego data that arrived on the edge. The red line shows the pods if all were always on."
)
_DELAYS = (
    "Seconds since the pose that crossed the distance was sent. A dot is an event. The red line is "
    "the median. For a join: the demand was accepted, its commit was published, the pods of the "
    "vehicle's connection had their nodes, the first fused message had its ego data. For a leave, "
    "the pods had ended. Pods start as processes of this machine, so no image is pulled."
)


def plots(outcome: Outcome) -> dict[str, str]:
    """Return the plots as SVG texts, by their names."""
    return {"map": _map(outcome), "timeline": _timeline(outcome), "delays": _delays(outcome)}


def page(outcome: Outcome, checks: Iterable[Check]) -> str:
    settings, images = outcome.settings, plots(outcome)
    poses = f"the poses of {settings.bag}" if settings.bag else f"seed {settings.seed}"
    title = escape(f"The experiment with {settings.gitops} and {settings.connections}, {poses}")
    head = f'<meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
    rows = "".join(f"<tr><td>{_mark(one)}</td><td>{_fault(one)}</td></tr>" for one in checks)
    return f"""<!doctype html>
<html lang="en"><head>{head}</head><body>
<h1>{title}</h1>
{_summary(outcome)}
<h2>What was checked</h2>
<table>{rows}</table>
<h2>The routes</h2>
{images["map"]}
<h2>Who was near, what ran, what arrived</h2>
{images["timeline"]}
<p>{_TIMELINE}</p>
<h2>From an event to its consequences</h2>
{images["delays"]}
<p>{_DELAYS}</p>
</body></html>"""


def _summary(outcome: Outcome) -> str:
    seconds, near = outcome.over - outcome.set_off, outcome.near
    text = (
        f"{len(outcome.routes)} vehicles drove for {seconds:.0f} s. One that is within "
        f"{near.start:g} m of the station demands perception on the edge, until it is "
        f"{near.stop:g} m away or silent for {near.timeout:g} s. The event detector formed "
        f"{len(outcome.formed)} demands from their poses. "
    )
    if not outcome.settings.large:
        text += (
            f"The poses reached it over MQTT. The vehicles stood for {outcome.held:.0f} s in all, "
            "each time until the last event had all its consequences."
        )
    return f"<p>{text}</p>"


def _mark(check: Check) -> str:
    kind = "ok" if check.holds else "fault"
    return f'<span class="{kind}">{kind}</span> {escape(check.name)}'


def _fault(check: Check) -> str:
    return escape(check.fault[:2000])


def _svg(height: float, parts: Iterable[str]) -> str:
    fonts = 'font-family="system-ui, sans-serif" font-size="12"'
    head = f'xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height:.0f}" {fonts}'
    paper = '<rect width="100%" height="100%" fill="#fff"/>'
    return f'<svg {head} role="img">{paper}{"".join(parts)}</svg>'


def _text(x: float, y: float, text: str, anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="#444">{escape(text)}</text>'


def _line(x1: float, y1: float, x2: float, y2: float, color: str = "#ccc") -> str:
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {ends} stroke="{color}"/>'


def _map(outcome: Outcome) -> str:
    """Return an SVG map of the poses that were sent, with circles at the distances of the rules."""
    middles = [near.point for near in outcome.crossings or (outcome.near,)]
    west, north = min(x for x, _ in middles) - 1.1 * FAR_M, max(y for _, y in middles) + 1.1 * FAR_M
    wide = max(x for x, _ in middles) + 1.1 * FAR_M - west
    size = 460.0
    scale = size / wide

    def place(x: float, y: float) -> tuple[float, float]:
        return (x - west) * scale, (north - y) * scale

    near, parts = outcome.near, []
    for point in middles:
        x, y = place(*point)
        parts += [
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius * scale:.1f}" fill="none" '
            f'stroke="#999" stroke-dasharray="{dash}"/>'
            for radius, dash in ((near.start, "none"), (near.stop, "4 4"))
        ]
        parts.append(_text(x + 5, y - near.start * scale - 6, f"{near.start:g} m"))
    is_few = len(outcome.routes) <= _MOST_ROWS
    driven: dict[str, list[tuple[float, float]]] = {}
    for pose in outcome.poses:
        driven.setdefault(pose.vehicle, []).append(place(pose.x, pose.y))
    for number, route in enumerate(outcome.routes):
        color, shift = _COLORS[number % len(_COLORS)], 4 * (number % len(_COLORS)) - 6
        places = dict.fromkeys(driven.get(route.vehicle, [])[::5])
        line = " ".join(f"{x + shift:.1f},{y + shift:.1f}" for x, y in places)
        width = 3 if is_few else 1
        parts.append(
            f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="{width}"/>'
        )
        if is_few:
            parts.append(f'<circle cx="520" cy="{40 + 24 * number}" r="5" fill="{color}"/>')
            parts.append(_text(534, 44 + 24 * number, f"{route.vehicle}, {route.label}"))
    for number, point in enumerate(middles):
        x, y = place(*point)
        parts.append(
            f'<rect x="{x - 4:.1f}" y="{y - 4:.1f}" width="8" height="8" fill="#222"/>'
            + _text(x + 8, y + 14, f"station{number:02}")
        )
    return _svg(size, parts)


def _timeline(outcome: Outcome) -> str:
    seconds = outcome.over - outcome.set_off
    scale = (_WIDTH - _LEFT - 20) / seconds

    def x(at: float) -> float:
        return _LEFT + (min(max(at, outcome.set_off), outcome.over) - outcome.set_off) * scale

    rows = [route.vehicle for route in outcome.routes]
    rows = rows if len(rows) <= _MOST_ROWS else []
    parts, height = list(_bars(outcome, rows, x)), 24 * len(rows) + 30
    counts = list(running(outcome))
    most = max((count for _, count in counts), default=1)
    always = len({pod.service for pod in outcome.pods})
    base, unit = height + 120.0, 110.0 / max(most, always, 1)
    points = [(outcome.set_off, 0), *counts, (outcome.over, counts[-1][1] if counts else 0)]
    path = "".join(f" H{x(at):.1f} V{base - count * unit:.1f}" for at, count in points)
    parts += [
        _text(_LEFT - 8, base - 4, "pods on demand", "end"),
        _line(_LEFT, base, _WIDTH - 20, base),
        f'<path d="M{_LEFT} {base:.1f}{path}" fill="none" stroke="#222"/>',
        _line(_LEFT, base - always * unit, _WIDTH - 20, base - always * unit, "#b00020"),
        _text(_LEFT - 8, base - always * unit + 4, f"always on: {always}", "end"),
    ]
    for tick in range(0, int(seconds) + 1, 10):
        at = _LEFT + tick * scale
        parts += [
            _line(at, base, at, base + 5, "#888"),
            _text(at, base + 18, f"{tick} s", "middle"),
        ]
    return _svg(base + 24, parts)


def _bars(outcome: Outcome, rows: Sequence[str], x: Callable[[float], float]) -> Iterator[str]:
    """Yield SVG elements that show when each vehicle was near and when its data arrived."""
    for row, vehicle in enumerate(rows):
        y, color = 12 + 24 * row, _COLORS[row % len(_COLORS)]
        yield _text(_LEFT - 8, y + 10, vehicle, "end")
        for begin, end in _stays(outcome, vehicle):
            yield (
                f'<rect x="{x(begin):.1f}" y="{y}" width="{x(end) - x(begin):.1f}" height="8" '
                f'fill="{color}" opacity="0.35"/>'
            )
        for at in outcome.arrivals.get(EGO_DATA.format(vehicle), ())[::2]:
            yield _line(x(at), y + 9, x(at), y + 15, color)


def _stays(outcome: Outcome, vehicle: str) -> Iterator[tuple[float, float]]:
    begin = None
    for event in outcome.events:
        if event.vehicle == vehicle:
            if event.joins:
                begin = event.at
            elif begin is not None:
                yield begin, event.at
                begin = None


def _delays(outcome: Outcome) -> str:
    rows = []
    for joins, word in ((True, "joins"), (False, "leaves")):
        delays = [step.delays() for step in steps(outcome) if step.event.joins is joins]
        rows += [
            (f"{word}: to {stage}", tuple(each[stage] for each in delays if stage in each))
            for stage in STAGES
        ]
    rows = [(name, values) for name, values in rows if values]
    longest = max((value for _, values in rows for value in values), default=1.0)
    scale = (_WIDTH - _LEFT - 160) / longest
    parts = []
    for number, (name, values) in enumerate(rows):
        y = 16 + 24 * number
        low, median, high = quantiles(values)
        parts.append(_text(_LEFT - 8, y + 4, name, "end"))
        parts.append(_line(_LEFT + low * scale, y, _LEFT + high * scale, y, "#888"))
        parts += [
            f'<circle cx="{_LEFT + value * scale:.1f}" cy="{y}" r="4" fill="{_COLORS[0]}" '
            'opacity="0.6"/>'
            for value in values
        ]
        x = _LEFT + median * scale
        parts.append(_line(x, y - 8, x, y + 8, "#b00020"))
        parts.append(_text(_WIDTH - 4, y + 4, f"median {median:.2f} s", "end"))
    return _svg(24 * len(rows) + 16, parts)
