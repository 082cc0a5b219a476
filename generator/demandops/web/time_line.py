"""The time line, and plots of rates and latencies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from functools import partial
from statistics import median
from typing import Any

from demandops.model.config.base_model import span
from demandops.model.config.override import OVERRIDES_ROOT
from demandops.repo.history.commit_message import PROPOSAL
from demandops.views.rows import Row
from demandops.views.source import WORDS, Commit, HealthChange

# ---- the time line of events ----

# The title of each lane of the time line, from top to bottom, by the lane's name.
LANES = {
    "demands": "Demands",
    "overrides": "Overrides",
    "people": "People and generator",
    "health": "Health",
}

# The spans of time that a person can choose, in seconds; 0 means all known events.
SPANS = {
    "15min": 900,
    "1h": 3600,
    "6h": 6 * 3600,
    "1d": 86400,
    "7d": 7 * 86400,
    "30d": 30 * 86400,
    "all": 0,
}

_STRIP_WIDTH = 1000
_BINS = 60
# The distances between ticks that people can read off easily, from a second to 30 days.
_STEPS_S = (1, 5, 15, 60, 300, 900, 3600, 4 * 3600, 86400, 7 * 86400, 30 * 86400)
_TICKS = 8

_BY_DEMANDS = {"join", "shutdown", "put", "release", "renew", "expire", "decommission", "rollback"}


@dataclass(frozen=True, slots=True)
class Event:
    lane: str
    time: datetime
    word: str
    summary: str
    who: str
    commit: str = ""
    release: str = ""
    tone: str = ""

    def row(self) -> Row:
        return Row(
            {
                "lane": [self.lane],
                "word": [self.word],
                "summary": [self.summary],
                "who": [self.who],
                "commit": [self.commit],
                "release": [self.release],
            }
        )


def events(commits: Iterable[Commit], health: Iterable[HealthChange]) -> list[Event]:
    all_events = [of_commit(commit) for commit in commits]
    for change in health:
        reason = f": {change.reason}" if change.reason else ""
        summary = f"was {change.before}, is {change.after}{reason}"
        tone = WORDS[change.after]
        all_events.append(
            Event("health", change.time, change.after, summary, "", "", change.release, tone)
        )
    return sorted(all_events, key=lambda event: event.time, reverse=True)


def of_commit(commit: Commit) -> Event:
    entry = commit.entry
    word = entry.first("Operation") or "by hand"  # only generators write this trailer
    lane = "people"
    if word in _BY_DEMANDS or PROPOSAL in entry.trailers:
        lane = "demands"
    elif word == "expire-override" or (word == "by hand" and OVERRIDES_ROOT in commit.roots):
        lane = "overrides"
    who = ", ".join(entry.trailers.get("Requester", ())) or entry.author
    return Event(lane, entry.time, word, entry.summary, who, entry.commit)


def strip(
    events: Sequence[Event], now: datetime, span: str, chosen: tuple[datetime, str] | None
) -> dict[str, Any]:
    # It ends at ``now``; the events are newest first. If ``span`` is no key of ``SPANS``, it is the
    # shortest that has enough events. ``chosen`` is the time and the id of the chosen commit.
    if span not in SPANS:
        # enough events are 20, or three quarters of all events, whichever is less
        last = min(20, 3 * len(events) // 4) - 1
        oldest_shown = events[last].time if len(events) > 1 else now
        spans = (name for name, seconds in SPANS.items() if seconds)
        span = next(
            (name for name in spans if oldest_shown >= now - timedelta(seconds=SPANS[name])), "all"
        )
    oldest = events[-1].time if events else now - timedelta(hours=1)
    start = now - timedelta(seconds=SPANS[span]) if SPANS[span] else oldest
    length = max((now - start).total_seconds(), 1.0)

    def x_of(at: datetime) -> float:
        return _STRIP_WIDTH * (at - start).total_seconds() / length

    bins: dict[tuple[str, int], list[Event]] = {}
    for event in events:
        if event.time >= start:
            # an event of this moment is in the last bin
            x = min(x_of(event.time), _STRIP_WIDTH - 1e-6)
            bins.setdefault((event.lane, int(x * _BINS / _STRIP_WIDTH)), []).append(event)
    dots = []
    for (lane, place), group in sorted(bins.items()):
        newest, count = group[0], len(group)
        more = f", and {count - 1} more" if count > 1 else ""
        what = " ".join(filter(None, (newest.release, newest.summary)))
        label = f"{newest.time:%Y-%m-%d %H:%M:%S} UTC, {newest.word}: {what}{more}"
        dot = {
            "lane": lane,
            "x": (place + 0.5) * _STRIP_WIDTH / _BINS,
            "radius": min(4.0 + math.log2(count), 8.0),
            "label": label,
            "commit": newest.commit,  # empty for a change of health
            "tone": "bad" if any(event.tone == "bad" for event in group) else newest.tone,
            "is_chosen": chosen is not None and any(e.commit == chosen[1] for e in group),
        }
        dots.append(dot)
    step = next((step for step in _STEPS_S if length / step <= _TICKS), length / _TICKS)
    form = "%H:%M:%S" if step < 60 else "%H:%M" if step < 86400 else "%m-%d"
    ticks, at = list[tuple[float, str]](), math.ceil(start.timestamp() / step) * step
    while at <= now.timestamp():
        moment = datetime.fromtimestamp(at, tz=timezone.utc)
        ticks.append((x_of(moment), moment.strftime(form)))
        at += step
    mark = x_of(chosen[0]) if chosen else -1
    shown = mark if 0 <= mark <= _STRIP_WIDTH else None
    return {"span": span, "dots": dots, "ticks": ticks, "chosen": shown}


# ---- plots of rates and latencies ----

WIDTH, HEIGHT = 560, 150
_RATE_BINS = 48


# When a value was measured, and the value.
Sample = tuple[datetime, float]

_BOOKED = {"join", "put"}
_RELEASED = {"shutdown", "release", "expire", "decommission"}


def plots(
    commits: Sequence[Commit], health: Sequence[HealthChange], now: datetime, span: str
) -> list[dict[str, Any]]:
    # A ``span`` that is no key of ``SPANS`` means the time since the oldest of ``commits``.
    seconds = SPANS.get(span, 0)
    oldest = commits[-1].entry.time if commits else now - timedelta(hours=1)
    start = now - timedelta(seconds=seconds) if seconds else oldest
    span_s = max((now - start).total_seconds(), 1.0)
    demands = [commit.entry for commit in commits if commit.entry.first("Operation-Id")]
    # The author's time of a demand's commit is when the generator received the demand.
    waits = [
        (entry.time, (entry.time - entry.authored).total_seconds())
        for entry in demands
        if entry.authored and entry.first("Operation") in _BOOKED | _RELEASED
    ]
    ready = [(change.time, change.lasted_s) for change in health if change.lasted_s is not None]
    by_people = [(commit.entry.time, 1.0) for commit in commits if not commit.entry.by_generator]
    rate = partial(_plot, start, span_s, True)
    latency = partial(_plot, start, span_s, False)
    return [
        rate("Demands booked", "commits that book a demand", _counted(commits, _BOOKED)),
        rate(
            "Demands released",
            "commits that release demands, or end demands whose lease expired",
            _counted(commits, _RELEASED),
        ),
        rate("People's commits", "commits that no generator made", by_people),
        latency("From received to committed", "median (Git records whole seconds)", waits),
        latency(
            "Until healthy again",
            "median time that releases were not healthy, since this page was started",
            ready,
        ),
    ]


def _counted(commits: Iterable[Commit], operations: set[str]) -> list[Sample]:
    entries = (commit.entry for commit in commits)
    return [(entry.time, 1.0) for entry in entries if entry.first("Operation") in operations]


def _plot(
    start: datetime, span_s: float, is_rate: bool, title: str, about: str, samples: list[Sample]
) -> dict[str, Any]:
    bin_s, bins = span_s / _RATE_BINS, [list[float]() for _ in range(_RATE_BINS)]
    for time, value in samples:
        place = int((time - start).total_seconds() / bin_s)
        if time >= start:
            bins[min(place, _RATE_BINS - 1)].append(value)
    every = sorted(value for measured in bins for value in measured)
    if is_rate:
        unit, suffix = f"per {span(bin_s)}", ""
        values = [float(len(measured)) for measured in bins]
        summary = f"{len(every)} in all, {len(every) * 3600 / span_s:.3g} an hour"
    else:
        unit, suffix, summary = "in seconds", " s", "no values in this span of time"
        values = [median(measured) if measured else 0.0 for measured in bins]
        if every:
            late = every[math.ceil(0.95 * len(every)) - 1]
            summary = f"median {median(every):.3g} s, 95 % within {late:.3g} s, {len(every)} values"
    top = max(*values, 1.0)  # at least 1, so that bins without a value divide by no zero
    width = WIDTH / _RATE_BINS
    starts = [start + timedelta(seconds=bin_s * n) for n in range(_RATE_BINS)]
    bars = [
        {
            "x": round(n * width + 1, 2),
            "y": round(HEIGHT * (1 - value / top), 2),
            "width": round(width - 2, 2),
            "height": round(HEIGHT * value / top, 2),
            "time": starts[n],
            "value": f"{value:.3g}{suffix}",
        }
        for n, value in enumerate(values)
        if value
    ]
    return {
        "title": title,
        "unit": unit,
        "about": about,
        "bars": bars,
        "top": f"{top:.3g}{suffix}",
        "first": start,
        "summary": summary,
    }
