"""The time line of events."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import Any

from demandops.base.runtime import REAL
from demandops.model.config.base_model import parse_time
from demandops.model.config.override import OVERRIDES_ROOT
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.history.commit_message import PROPOSAL
from demandops.views.rows import TONES, Row
from demandops.views.vocabulary import Json

# The title of each lane of the time line, from top to bottom, by the lane's name.
LANES = {
    "demands": "Demands",
    "overrides": "Overrides",
    "people": "People and generator",
    "health": "Health",
}

# The spans of time that a person can choose, in seconds; 0 means all known events.
SPANS = {
    "15min": 900, "1h": 3600, "6h": 6 * 3600,
    "1d": 86400, "7d": 7 * 86400, "30d": 30 * 86400, "all": 0,
}  # fmt: skip

# How many events a span that nobody chose must have, if there are more.
_ENOUGH = 50
_STRIP_WIDTH = 1000
_BINS = 60
# The distances between ticks that people can read off easily, from a second to 30 days.
_STEPS_S = (1, 5, 15, 60, 300, 900, 3600, 4 * 3600, 86400, 7 * 86400, 30 * 86400)
_TICKS = 8


@dataclass(frozen=True, slots=True)
class Event:
    lane: str
    time: datetime
    word: str
    summary: str
    who: str = ""
    commit: str = ""
    why: str = ""
    decision: Json | None = None
    release: str = ""  # whose health has changed
    tone: str = ""

    def row(self) -> Row:
        names = ("lane", "word", "summary", "who", "commit", "release")
        return Row({name: [getattr(self, name)] for name in names})


# The operations of commits that book demands, and of those that end them.
BOOKED = frozenset({"join", "put"})
RELEASED = frozenset({"shutdown", "release", "expire", "decommission"})
_BY_DEMANDS = BOOKED | RELEASED | {"renew", "rollback"}


def lane_of(entry: LogEntry, roots: Collection[str]) -> str:
    # ``roots`` are the top-level files and folders that the commit changed
    operation = entry.first("Operation")  # only generators write this trailer
    if operation in _BY_DEMANDS or PROPOSAL in entry.trailers:
        return "demands"
    if operation == "expire-override" or (not operation and OVERRIDES_ROOT in roots):
        return "overrides"
    return "people"


def of_commit(commit: Json, lane: str = "", word: str = "") -> Event:
    return Event(
        lane,
        parse_time(commit["time"]),
        word or commit["operation"] or "by hand",
        commit["summary"],
        commit["who"],
        commit["commit"],
        commit["why"] or "",
        commit["decision"],
    )


def of_health(release: str, before: str, after: str, reason: str) -> Event:
    summary = f"was {before}, is {after}{f': {reason}' if reason else ''}"
    return Event("health", REAL.now(), after, summary, release=release, tone=TONES[after])


def within(events: Sequence[Event], span: str, now: datetime) -> tuple[str, list[Event]]:
    """Return the name of a span of time, and the events of that span, which may be no key.

    Then it is the shortest span that has most events or a page of them.
    """
    if span not in SPANS:
        enough = events[min(_ENOUGH, 3 * len(events) // 4) - 1].time if len(events) > 1 else None
        holding = (
            name
            for name, seconds in SPANS.items()
            if enough and seconds and enough >= now - timedelta(seconds=seconds)
        )
        span = next(holding, "all")
    start = now - timedelta(seconds=SPANS[span])
    return span, [event for event in events if not SPANS[span] or event.time >= start]


def strip(
    events: Sequence[Event], now: datetime, span: str, chosen: tuple[datetime, str] | None
) -> dict[str, Any]:
    # It ends at ``now``; the events are those of the span, newest first. ``chosen`` is the time and
    # the id of the chosen commit.
    oldest = events[-1].time if events else now - timedelta(hours=1)
    start = now - timedelta(seconds=SPANS[span]) if SPANS[span] else oldest
    length = max((now - start).total_seconds(), 1.0)

    def x_of(at: datetime) -> float:
        return _STRIP_WIDTH * (at - start).total_seconds() / length

    bins: dict[tuple[str, int], list[Event]] = {}
    for event in events:
        # an event of this moment is in the last bin
        x = min(x_of(event.time), _STRIP_WIDTH - 1e-6)
        bins.setdefault((event.lane, int(x * _BINS / _STRIP_WIDTH)), []).append(event)
    dots = []
    for (lane, place), group in sorted(bins.items()):
        newest, count = group[0], len(group)
        more = f", and {count - 1} more" if count > 1 else ""
        what = " ".join(filter(None, (newest.release, newest.summary)))
        dot = {
            "lane": lane,
            "x": (place + 0.5) * _STRIP_WIDTH / _BINS,
            "radius": min(4.0 + math.log2(count), 8.0),
            "label": f"{newest.time:%Y-%m-%d %H:%M:%S} UTC, {newest.word}: {what}{more}",
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
    return {"dots": dots, "ticks": ticks, "chosen": mark if 0 <= mark <= _STRIP_WIDTH else None}
