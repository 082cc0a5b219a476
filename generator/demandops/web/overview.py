"""The overview: the fleet in figures, what is not ready, and what changed of late."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import groupby

from demandops.cluster.release_status import ReleaseStatus
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.release import ServiceRelease
from demandops.views.causes import Cause
from demandops.views.kinds import rows_of
from demandops.views.rows import TONES, Filter, Row, exactly
from demandops.views.source import RANKS, Source, worst_word
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

    def of_list(rows: list[Row], what: str, view: str) -> Figure:
        counts = Counter(row.item["health"] or "unknown" for row in rows)
        words = [
            (Part(f"{count} {word}", view, {"q": exactly("health", word)}), TONES[word])
            for word, count in sorted(counts.items(), key=lambda pair: RANKS[pair[0]])
        ]
        return Figure(len(rows), Part(_counted(len(rows), what), view), words)

    services, connections, demands = map(matching, ("services", "connections", "demands"))
    requesters = {who for row in demands for who in row.item["requesters"]}
    nodes = {id for row in demands for id in row.item["nodes"]} & source.config.nodes.keys()
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
        of_list(services, "service", "services"),
        of_list(connections, "connection", "connections"),
        of_list(demands, "demand", "demands"),
        Figure(
            len(requesters),
            Part(_counted(len(requesters), "requester"), "requesters"),
        ),
        Figure(len(nodes), Part(f"of {len(source.config.nodes)} nodes used", "map")),
        Figure(
            sum(count for count, _ in waits),
            Part("waiting", "proposals"),
            [part for _, part in waits],
        ),
        Figure(
            len(last_hour),
            Part(
                f"{_counted(len(last_hour), 'change')} in the last hour", "timeline", {"span": "1h"}
            ),
            [rate(last_hour, "hour"), rate(last_day, "day")],
        ),
    ]


def _counted(count: int, word: str) -> str:
    return word if count == 1 else f"{word}s"


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
    return Part(cause.what, "services", {"q": query}) if cause.releases else Part(cause.what)


@dataclass(frozen=True, slots=True)
class Ready:
    application: str
    word: str  # for a health, or the kind of the first cause
    is_ready: bool


def applications(source: Source, causes: Iterable[Cause], wanted: Filter) -> list[Ready]:
    first_causes: dict[str, Cause] = {}
    for cause in causes:
        for application in cause.applications:
            first_causes.setdefault(application, cause)
    statuses = defaultdict[str, list[ReleaseStatus]](list)
    claims_of = defaultdict[str, list[Claim]](list)
    for name, release in source.releases.items():
        for application in release.applications if isinstance(release, ServiceRelease) else ():
            statuses[application].append(source.status(name))
    for claim in source.state.ledger:
        if claim.is_on_application:
            claims_of[claim.subject.id].append(claim)
    shown = []
    for application, claims in sorted(claims_of.items()):
        texts = {"requester": requesters_of(claims), "demand": [claim.demand for claim in claims]}
        if wanted.matches(Row(texts | {"application": [application]})):
            word, first = worst_word(statuses[application]), first_causes.get(application)
            # what runs well may still be denied or invalid; then the cause says more
            if first and word in ("healthy", "unknown"):
                word = first.kind
            shown.append(Ready(application, word, first is None))
    return sorted(shown, key=lambda ready: (ready.is_ready, ready.application))
