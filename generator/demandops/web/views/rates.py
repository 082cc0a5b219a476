"""Plots of rates and latencies.

The rates are those of demands that are booked or released, and of people's commits. The latencies
are the time from the receipt of a demand to its commit, and the time until a release is healthy
again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from statistics import median

from demandops.config.durations import span
from demandops.web.situation import Commit, HealthChange
from demandops.web.views.time_line import SPANS

WIDTH, HEIGHT = 560, 150
_BINS = 48


@dataclass(frozen=True, slots=True)
class Bar:
    x: float
    y: float
    width: float
    height: float
    label: str  # when its bin of time begins, and its value


@dataclass(frozen=True, slots=True)
class Plot:
    """A plot: its bars, the highest value of the axis as text, and the values as a table.

    Bins of time whose value is 0 have neither a bar nor a line in the table.
    """

    title: str
    unit: str
    about: str
    bars: tuple[Bar, ...]
    top: str
    first: datetime
    last: datetime
    summary: str
    table: tuple[tuple[datetime, str], ...]


# When a value was measured, and the value.
Sample = tuple[datetime, float]

_BOOKED = {"join", "put"}
_RELEASED = {"shutdown", "release", "expire", "decommission"}


def plots(
    commits: Sequence[Commit], health: Sequence[HealthChange], now: datetime, span: str
) -> list[Plot]:
    """Return the plots of a span of time that ends at ``now``.

    ``span`` is a key of ``SPANS``. ``all``, and any text that is no key, means the time since the
    oldest of ``commits``; without commits, the last hour.
    """
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
    make = _PlotMaker(start, span_s)
    return [
        make.counts("Demands booked", _times(commits, _BOOKED), "commits that book a demand"),
        make.counts(
            "Demands released",
            _times(commits, _RELEASED),
            "commits that release demands, or end demands whose lease expired",
        ),
        make.counts(
            "People's commits",
            [commit.entry.time for commit in commits if not commit.entry.by_generator],
            "commits that no generator made",
        ),
        make.medians("From received to committed", waits, "median (Git records whole seconds)"),
        make.medians(
            "Until healthy again",
            ready,
            "median time that releases were not healthy, since this page was started",
        ),
    ]


def _times(commits: Iterable[Commit], operations: set[str]) -> list[datetime]:
    entries = (commit.entry for commit in commits)
    return [entry.time for entry in entries if entry.first("Operation") in operations]


class _PlotMaker:
    def __init__(self, start: datetime, span_s: float) -> None:
        self._start, self._bin_s = start, span_s / _BINS
        self._span = span_s

    def counts(self, title: str, times: Iterable[datetime], about: str) -> Plot:
        bins = self._bins((at, 1.0) for at in times)
        total = sum(map(len, bins))
        per_hour = total * 3600 / self._span
        summary = f"{total} in all, {per_hour:.3g} an hour"
        values = [float(len(each)) for each in bins]
        return self._plot(title, f"per {span(self._bin_s)}", about, values, summary, "")

    def medians(self, title: str, samples: Iterable[Sample], about: str) -> Plot:
        bins = self._bins(samples)
        every = sorted(value for each in bins for value in each)
        summary = "no values in this span of time"
        if every:
            late = every[math.ceil(0.95 * len(every)) - 1]
            summary = f"median {median(every):.3g} s, 95 % within {late:.3g} s, {len(every)} values"
        values = [median(each) if each else 0.0 for each in bins]
        return self._plot(title, "in seconds", about, values, summary, " s")

    def _bins(self, samples: Iterable[Sample]) -> list[list[float]]:
        bins: list[list[float]] = [[] for _ in range(_BINS)]
        for time, value in samples:
            place = int((time - self._start).total_seconds() / self._bin_s)
            if time >= self._start:
                bins[min(place, _BINS - 1)].append(value)
        return bins

    def _plot(
        self, title: str, unit: str, about: str, values: list[float], summary: str, suffix: str
    ) -> Plot:
        top = max(*values, 1.0)  # at least 1, so that bins without a value divide by no zero
        width = WIDTH / _BINS
        starts = [self._start + timedelta(seconds=self._bin_s * n) for n in range(_BINS)]
        texts = [f"{value:.3g}{suffix}" for value in values]
        bars = tuple(
            Bar(
                round(n * width + 1, 2),
                round(HEIGHT * (1 - value / top), 2),
                round(width - 2, 2),
                round(HEIGHT * value / top, 2),
                f"{starts[n]:%Y-%m-%d %H:%M:%S} UTC: {texts[n]}",
            )
            for n, value in enumerate(values)
            if value
        )
        table = tuple((starts[n], texts[n]) for n, value in enumerate(values) if value)
        end = self._start + timedelta(seconds=self._span)
        return Plot(
            title, unit, about, bars, f"{top:.3g}{suffix}", self._start, end, summary, table
        )
