"""The page's views, by address: what each finds, and what its template gets."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import groupby, islice
from typing import Any
from urllib.parse import urlencode

from starlette.requests import Request

from demandops.model.config.base_model import parse_time
from demandops.model.release import ServiceRelease
from demandops.views import causes as cause_list
from demandops.views import why
from demandops.views.kinds import KINDS, Kind, past_rows, rows_of
from demandops.views.rows import RANKS, TONES, Filter, Row, exactly, page_of, sorted_rows
from demandops.views.source import Source
from demandops.views.vocabulary import Json
from demandops.web import fleet_map, time_line
from demandops.web.follower import MOST_COMMITS, Follower
from demandops.web.time_line import Event

# The lists of the page, in the order of its navigation.
LISTS = (
    *("demands", "applications", "releases", "connections", "nodes", "requesters", "leases"),
    *("overrides", "proposals"),
)
NAVIGATION = (
    ("", "Overview"),
    ("map", "Map"),
    *((name, KINDS[name].title) for name in LISTS),
    ("timeline", "Time line"),
)

# The parameters that a link to another view keeps: the chosen commit or time, and the filter.
_KEPT = ("at", "q")
_ROWS = 100  # that a page of a list has at most

_MOST_CAUSES = 100
_NEWEST = 8  # changes
_COMMITS = 20  # of one thing
_MOST_ROWS = 200  # of what it holds, and of what runs for it

Data = dict[str, Any]
View = Callable[["ViewRequest"], tuple[str, Data]]


@dataclass(frozen=True, slots=True)
class Part:
    text: str
    view: str = ""  # to which it links, with parameters
    params: Mapping[str, str] = field(default_factory=dict)


class ViewRequest:
    def __init__(self, follower: Follower, request: Request) -> None:
        self.follower = follower
        self.path = request.url.path.strip("/")
        self.params = dict(request.query_params)
        self.source: Source = follower.at(self.get("at"))
        self.filter = Filter(self.get("q"))

    def get(self, name: str) -> str:
        # an address may have any length
        return self.params.get(name, "").strip()[:500]

    def page(self) -> int:
        # `isdigit` accepts "²", of which `int` makes no number
        text = self.get("page")
        return int(text) if text.isascii() and text.isdigit() and len(text) < 7 else 1

    def to(self, path: str | None = None, **changes: str | int) -> str:
        # The address of a view, with the chosen commit or time and the filter. Without ``path``, it
        # is this view with all its parameters. An empty value removes one.
        kept = {name: value for name, value in self.params.items() if path is None or name in _KEPT}
        params = {name: value for name, value in {**kept, **changes}.items() if value != ""}
        query = f"?{urlencode(params)}" if params else ""
        return f"/{self.path if path is None else path}{query}"

    def rows(self, name: str) -> list[Row]:
        return [row for row in rows_of(self.source, name) if self.filter.matches(row)]

    def events(self) -> list[Event]:
        every = (*self.follower.history, *self.follower.health_changes)
        found = (event for event in every if not self.filter or self.filter.matches(event.row()))
        return sorted(found, key=lambda event: event.time, reverse=True)

    def link(self, part: Part) -> str:
        # with its own filter instead of the current one
        return self.to(part.view, **{"q": "", **part.params})


def _figures(asked: ViewRequest, events: list[Event]) -> list[Data]:
    # the fleet in figures: a number and what it counts, which links to a list; and what stands out
    # of that list, with its color
    source, demands = asked.source, asked.rows("demands")
    figures: list[Data] = []
    for name in ("releases", "connections", "demands", "requesters"):
        rows = demands if name == "demands" else asked.rows(name)
        counts = Counter(row.item["health"] or "unknown" for row in rows)
        parts = [
            (Part(f"{count} {word}", name, {"q": exactly("health", word)}), TONES[word])
            for word, count in sorted(counts.items(), key=lambda pair: RANKS[pair[0]])
        ]
        what = Part(name.removesuffix("s") if len(rows) == 1 else name, name)
        figures.append({"count": len(rows), "what": what, "parts": parts})
    used = [row for row in asked.rows("nodes") if row.item["demands"] and row.item["type"]]
    what = Part(f"of {len(source.nodes)} nodes used", "nodes")
    figures.append({"count": len(used), "what": what, "parts": ()})
    proposed = len(source.proposals)
    waiting = sum(row.item["state"] == "waiting" for row in demands)
    parts = [(Part(f"{proposed} for approval", "proposals"), "busy")] if proposed else []
    if waiting:
        query = {"q": exactly("state", "waiting")}
        parts.append((Part(f"{waiting} for room", "demands", query), "busy"))
    what = Part("waiting", "proposals")
    figures.append({"count": proposed + waiting, "what": what, "parts": parts})
    moment = source.now if source.is_newest else source.entry.time
    late, figures_of = list[int](), dict[str, str]()
    for span, hours in (("hour", 1), ("day", 24)):
        recent = [event for event in events if event.time >= moment - timedelta(hours=hours)]
        booked = sum(event.word in time_line.BOOKED for event in recent)
        released = sum(event.word in time_line.RELEASED for event in recent)
        figures_of[f"{booked} booked, {released} released"] = span  # told once if they are equal
        late.append(len(recent))
    changes = "change" if late[0] == 1 else "changes"
    what = Part(f"{changes} in the last hour", "timeline", {"span": "1h"})
    parts = [(Part(f"{told} in the last {span}"), "") for told, span in figures_of.items()]
    return [*figures, {"count": late[0], "what": what, "parts": parts}]


def _overview(asked: ViewRequest) -> tuple[str, Data]:
    source = asked.source
    moment = source.now if source.is_newest else source.entry.time
    events = [event for event in asked.events() if event.time <= moment]
    # What is not ready, with a link to the thing or to the releases that it is about.
    causes = [cause for cause in cause_list.causes(source) if asked.filter.matches(cause.row)]
    links = []
    for cause in causes[:_MOST_CAUSES]:
        (kind, name), link = cause.thing, Part(cause.what)
        if kind:
            link = Part(cause.what, "thing", {"kind": kind, "name": name})
        elif cause.releases:
            query = f"{exactly('cluster', cause.cluster)} {exactly('health', cause.kind)}"
            link = Part(cause.what, "releases", {"q": query})
        links.append((cause, link))

    # Each application with a word for its health and its worst cause. What runs well may still be
    # denied or invalid. Then the kind of the cause says more.
    worst: dict[str, cause_list.Cause] = {}
    for cause in causes:
        for name in cause.applications:
            worst.setdefault(name, cause)
    applications = []
    for row in asked.rows("applications"):
        name, word = row.item["name"], row.item["health"] or "unknown"
        first = worst.get(name)
        is_said = word not in ("healthy", "unknown")
        applications.append((name, first.kind if first and not is_said else word, first))

    # The newest changes, with how many releases have the same change of health after one another.
    newest = groupby(events, lambda event: event.commit or (event.summary, event.tone))
    groups = ([*same] for _, same in islice(newest, _NEWEST))
    return "overview.html.j2", {
        "figures": _figures(asked, events),
        "causes": links,
        "total": len(causes),
        "applications": sorted(applications, key=lambda each: (each[2] is None, each[0])),
        "events": [(group[0], len(group)) for group in groups],
        "overrides": source.overrides,
    }


def _list(asked: ViewRequest) -> tuple[str, Data]:
    kind, now, sort = KINDS[asked.path], asked.source.now, asked.get("sort")
    gone, kept = kind.has_past and bool(asked.get("gone")), asked.source.derived
    if gone and f"past {kind.name}" not in kept:
        kept[f"past {kind.name}"] = past_rows(asked.source, kind.name)[0]
    every = kept[f"past {kind.name}"] if gone else rows_of(asked.source, kind.name)
    matching = [row for row in every if asked.filter.matches(row)]
    columns = {column.key: column for column in kind.columns if not column.only_wide}
    if (key := sort.removeprefix("-")) in columns:  # `-` before a key is the reverse order
        matching = sorted_rows(matching, columns[key], now, down=sort.startswith("-"))
    shown, page, pages = page_of(matching, asked.page(), _ROWS)
    return "list.html.j2", {
        "kind": kind,
        "gone": gone,
        "table": _table(kind, [row.item for row in shown], now),
        "total": len(every),
        "matching": len(matching),
        "sort": sort,
        "page": page,
        "pages": pages,
    }


def _table(kind: Kind, items: Collection[Json], now: datetime) -> Data:
    rows: list[list[Data]] = [[] for _ in items]
    used: set[str] = set()  # of the columns that only some rows fill, those that a row fills
    for item, cells in zip(items, rows, strict=True):
        for column in kind.columns:
            if column.only_wide and column.form != "command":
                continue
            texts = column.texts(item, now)
            time = item.get(column.key) if column.form == "time" else None  # instead of texts
            parts = []
            for text in texts:
                params = {"kind": column.links, "name": text}
                if column.links == "held":  # an application or a connection, which may be said
                    word, _, name = text.rpartition(" ")
                    params = {"kind": word.replace("held for", "application"), "name": name}
                parts.append(Part(text, "thing" if column.links else "", params))
            at = parse_time(time) if time else None
            cells.append({"column": column, "parts": parts, "time": at})
            if parts:
                used.add(column.key)
    wanted = [c for c in kind.columns if not c.only_wide and (c.key in used or not items)]
    return {"columns": wanted, "rows": rows}


def _timeline(asked: ViewRequest) -> tuple[str, Data]:
    now, lane = asked.source, asked.get("lane")
    lanes = {lane} if lane in time_line.LANES else time_line.LANES
    events = [event for event in asked.events() if event.lane in lanes]
    span, events = time_line.within(events, asked.get("span"), now.now)
    chosen = None if now.is_newest else (now.entry.time, now.commit)
    shown, page, pages = page_of(events, asked.page(), size=50)
    return "timeline.html.j2", {
        "strip": time_line.strip(events, now.now, span, chosen),
        "span": span,
        "lanes": time_line.LANES,
        "lane": lane,
        "spans": time_line.SPANS,
        "events": shown,
        "total": len(events),
        "page": page,
        "pages": pages,
        "changed": now.reader().files_changed_by(now.commit) if asked.get("at") else (),
        "is_cut": len(asked.follower.history) >= MOST_COMMITS,
    }


def _thing(asked: ViewRequest) -> tuple[str, Data]:
    # `/demand?id=` and `/release?name=` are in people's bookmarks
    kind = asked.get("kind") if asked.path == "thing" else asked.path
    name = asked.get("id") or asked.get("name")
    health = asked.follower.health_changes if asked.source.is_newest else ()
    return "thing.html.j2", thing(asked.source, name, kind, health)


def thing(source: Source, name: str, kind: str, health: Iterable[Event]) -> Data:
    # what it is, why, what it holds, its time line, and what to do
    answer = why.explain(source, why.find(source, name, kind or None), _COMMITS)
    kind, name, word = answer["kind"], answer["name"], answer["state"]
    runs = kind == "release" and word == "runs"
    if runs:
        word = answer["health"] or "unknown"
    # the commits and the changes of health that touch it, newest first
    events = [time_line.of_commit(commit, word=did) for did, commit in why.commits_of(answer)]
    names = {name, *(release["name"] for release in answer.get("releases", ()))}
    events += [change for change in health if change.release in names]
    claims, releases = answer.get("claims", ()), answer.get("releases", ())
    difference, effect = why.last_difference(source, answer)
    data: Data = {
        "it": answer,
        "word": word,
        "claims": _table(KINDS["claims"], claims[:_MOST_ROWS], source.now),
        "releases": _table(KINDS["releases"], releases[:_MOST_ROWS], source.now),
        "most": _MOST_ROWS,
        "events": sorted(events, key=lambda event: event.time, reverse=True),
        "difference": difference,
        "effect": effect,
        "text": answer["file"] and source.reader().file_reader(source.commit)(answer["file"]),
        "released": None,
        "stopped_with": [],
        "stop": "",
    }
    if kind == "demand" and answer["claims"]:
        data["released"], data["refused"] = why.release_of(source, name)
    if runs:
        release = source.releases[name]
        if isinstance(release, ServiceRelease):
            selection = ["--service", release.key.service, "--node", release.node.id]
        else:
            selection = [word for id in release.connections for word in ("--connection", id)]
        data["stopped_with"] = why.stopped_with(source, name)
        data["stop"] = shlex.join(["demandops", "suspend", *selection, "-m", "REASON"])
    return data


VIEWS: Mapping[str, View] = {
    "/": _overview,
    "/map": lambda asked: (
        "map.html.j2",
        {"map": fleet_map.picture(asked.source, asked.filter, asked.get("layout"))},
    ),
    **{f"/{name}": _list for name in (*LISTS, "services")},
    "/thing": _thing,
    "/demand": _thing,
    "/release": _thing,
    "/timeline": _timeline,
}
