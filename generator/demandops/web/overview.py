"""The overview: the fleet in figures, what is not ready, and what changed of late."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import groupby

from demandops.views.causes import Cause
from demandops.views.kinds import rows_of
from demandops.views.rows import TONES, Filter, Row, exactly
from demandops.views.source import RANKS, Source
from demandops.web.lists import Part
from demandops.web.time_line import BOOKED, RELEASED, Event


@dataclass(frozen=True, slots=True)
class Figure:
    """A number and what it counts, which links to a list; and what stands out of that list."""

    count: int
    what: Part
    parts: Sequence[tuple[Part, str]] = ()  # each with its color


def figures(source: Source, wanted: Filter, events: Iterable[Event], now: datetime) -> list[Figure]:
    """Return the figures of what the filter finds; ``events`` are those that it finds, ever."""

    def matching(name: str) -> list[Row]:
        return [row for row in rows_of(source, name) if wanted.matches(row)]

    def of_list(name: str) -> Figure:
        rows = matching(name)
        counts = Counter(row.item["health"] or "unknown" for row in rows)
        words = [
            (Part(f"{count} {word}", name, {"q": exactly("health", word)}), TONES[word])
            for word, count in sorted(counts.items(), key=lambda pair: RANKS[pair[0]])
        ]
        return Figure(len(rows), Part(_counted(len(rows), name), name), words)

    used = [row for row in matching("nodes") if row.item["demands"] and row.item["type"]]
    demands = matching("demands")
    waiting = [row for row in demands if row.item["state"] == "waiting"]
    waits = [
        (count, (Part(f"{count} for {what}", view, params), "busy"))
        for count, what, view, params in (
            (len(source.proposals), "approval", "proposals", {}),
            (len(waiting), "room", "demands", {"q": exactly("state", "waiting")}),
        )
        if count
    ]
    last_day = [event for event in events if now - timedelta(days=1) <= event.time <= now]
    last_hour = [event for event in last_day if event.time >= now - timedelta(hours=1)]

    def rate(some: list[Event], span: str) -> tuple[Part, str]:
        booked, released = (sum(e.word in words for e in some) for words in (BOOKED, RELEASED))
        return Part(f"{booked} booked, {released} released in the last {span}"), ""

    return [
        *map(of_list, ("releases", "connections", "demands", "requesters")),
        Figure(len(used), Part(f"of {len(source.config.nodes)} nodes used", "nodes")),
        Figure(
            sum(count for count, _ in waits),
            Part("waiting", "proposals"),
            [part for _, part in waits],
        ),
        Figure(
            len(last_hour),
            Part(
                f"{_counted(len(last_hour), 'changes')} in the last hour",
                "timeline",
                {"span": "1h"},
            ),
            [rate(last_hour, "hour"), rate(last_day, "day")],
        ),
    ]


def _counted(count: int, words: str) -> str:
    return words.removesuffix("s") if count == 1 else words


def newest(events: Sequence[Event]) -> Iterator[tuple[Event, int]]:
    """Yield events, with how many releases have the same change of health after one another."""
    for _, same in groupby(events, lambda event: event.commit or (event.summary, event.tone)):
        group = [*same]
        yield group[0], len(group)


def link_of(cause: Cause) -> Part:
    kind, name = cause.thing
    if kind:
        return Part(cause.what, "thing", {"kind": kind, "name": name})
    query = f"{exactly('cluster', cause.cluster)} {exactly('health', cause.kind)}"
    return Part(cause.what, "releases", {"q": query}) if cause.releases else Part(cause.what)


def applications(
    source: Source, causes: Iterable[Cause], wanted: Filter
) -> list[tuple[str, str, Cause | None]]:
    """Return each application with a word for its health and its worst cause; unready ones first.

    What runs well may still be denied or invalid. Then the kind of the cause says more.
    """
    worst: dict[str, Cause] = {}
    for cause in causes:
        for name in cause.applications:
            worst.setdefault(name, cause)
    shown = []
    for row in filter(wanted.matches, rows_of(source, "applications")):
        name, word = row.item["name"], row.item["health"] or "unknown"
        first = worst.get(name)
        is_said = word not in ("healthy", "unknown")
        shown.append((name, first.kind if first and not is_said else word, first))
    return sorted(shown, key=lambda each: (each[2] is None, each[0]))
