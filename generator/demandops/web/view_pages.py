"""The views: for each address, the function that returns a template and its data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any
from urllib.parse import urlencode

from starlette.requests import Request

from demandops.views.override_report import override_state
from demandops.web import filtered_table, fleet_map, not_ready, release_view, time_line
from demandops.web.filtered_table import Filter, Link, Row
from demandops.web.follower import MOST_COMMITS, Follower
from demandops.web.lists import LISTS, rows_of
from demandops.web.situation import Situation

# The parameters that a link to another view keeps: the chosen commit or time, and the filter.
_KEPT = ("at", "q")

NAVIGATION = (
    ("", "Not ready"),
    ("map", "Map"),
    *((kind.name, kind.title) for kind in LISTS.values()),
    ("timeline", "Time line"),
    ("overrides", "Overrides"),
    ("rates", "Rates"),
)

_MOST_CAUSES = 100
_EVENTS_ON_A_PAGE = 50

Data = dict[str, Any]
View = Callable[["ViewRequest"], tuple[str, Data]]


class ViewRequest:
    """A request for a view: its parameters, the chosen situation and the chosen filter."""

    def __init__(self, follower: Follower, request: Request) -> None:
        self.follower = follower
        self.path = request.url.path.strip("/")
        self.params = dict(request.query_params)
        self.situation: Situation = follower.at(self.get("at"))
        self.filter = Filter(self.get("q"))

    def get(self, name: str) -> str:
        """Return the value of a parameter, at most 500 characters; empty if it is not given."""
        return self.params.get(name, "").strip()[:500]

    def page(self) -> int:
        """Return the number of the requested page; 1 if the request gives no number."""
        # `isdigit` accepts "²", of which `int` makes no number
        text = self.get("page")
        return int(text) if text.isascii() and text.isdigit() and len(text) < 7 else 1

    def to(self, path: str | None = None, **changes: str | int) -> str:
        """Return the address of a view, with the chosen commit or time and the filter.

        Without ``path``, return the address of this view with all its parameters. ``changes`` are
        new values of parameters; an empty value removes the parameter.
        """
        kept = {name: value for name, value in self.params.items() if path is None or name in _KEPT}
        params = {name: value for name, value in {**kept, **changes}.items() if value != ""}
        query = f"?{urlencode(params)}" if params else ""
        return f"/{self.path if path is None else path}{query}"

    def link(self, link: Link) -> str:
        """Return the address of a link, with its own filter instead of the current one."""
        return self.to(link.path, **{"q": "", **link.params})


def _not_ready(asked: ViewRequest) -> tuple[str, Data]:
    commit_state = asked.situation.commit_state
    last_change = partial(asked.follower.last_change, commit_state)
    pending = asked.follower.not_rendered(commit_state)
    causes = not_ready.causes(asked.situation, asked.filter, last_change, pending)
    applications = not_ready.applications(asked.situation, causes, asked.filter)
    data = {"causes": causes[:_MOST_CAUSES], "total": len(causes), "applications": applications}
    return "not_ready.html.j2", data


def _map(asked: ViewRequest) -> tuple[str, Data]:
    picture = fleet_map.picture(asked.situation, asked.filter, asked.get("layout"))
    return "map.html.j2", {"map": picture}


def _list(asked: ViewRequest) -> tuple[str, Data]:
    kind = LISTS[asked.path]
    rows = rows_of(asked.situation, kind.name)
    table = filtered_table.table(kind.columns, rows, asked.filter, asked.get("sort"), asked.page())
    return "list.html.j2", {"kind": kind, "table": table}


def _demand(asked: ViewRequest) -> tuple[str, Data]:
    demand = release_view.explained_demand(
        asked.situation, asked.follower.reader(), asked.get("id")
    )
    return "demand.html.j2", {"demand": demand}


def _release(asked: ViewRequest) -> tuple[str, Data]:
    now, reader = asked.situation, asked.follower.reader()
    release = release_view.explained_release(now, reader, asked.get("name"))
    return "release.html.j2", {"release": release}


def _timeline(asked: ViewRequest) -> tuple[str, Data]:
    now, lane = asked.situation, asked.get("lane")
    events = time_line.events(asked.follower.history, asked.follower.health_changes)
    events = time_line.matching(events, asked.filter, lane if lane in time_line.LANES else "")
    chosen = None if now.is_newest else (now.commit_state.entry.time, now.commit_state.commit)
    changed: list[str] = []
    if asked.get("at"):
        changed = asked.follower.reader().files_changed_by(now.commit_state.commit)
    shown, page, pages = filtered_table.page_of(events, asked.page(), _EVENTS_ON_A_PAGE)
    return "timeline.html.j2", {
        "strip": time_line.strip(events, now.now, asked.get("span"), chosen),
        "lanes": time_line.LANES,
        "lane": lane,
        "spans": time_line.SPANS,
        "events": shown,
        "total": len(events),
        "page": page,
        "pages": pages,
        "changed": changed,
        "is_cut": len(asked.follower.history) >= MOST_COMMITS,
    }


def _overrides(asked: ViewRequest) -> tuple[str, Data]:
    now, entries = asked.situation, []
    pending = asked.follower.not_rendered(now.commit_state)
    for entry in now.commit_state.override_entries(now.now):
        state = override_state(entry, now.commit_state.state, pending)
        texts = {
            "owner": [entry.override.owner],
            "reason": [entry.override.reason],
            "release": [release.name for release in entry.releases],
            "demand": [claim.demand for claim in entry.claims],
            "requester": [who for claim in entry.claims for who in claim.requesters],
        }
        if asked.filter.matches(Row({"override": filtered_table.cell(entry.override.name)}, texts)):
            entries.append(replace(entry, state=state))
    return "overrides.html.j2", {"entries": entries}


def _rates(asked: ViewRequest) -> tuple[str, Data]:
    span = asked.get("span") if asked.get("span") in time_line.SPANS else "1d"
    health = asked.follower.health_changes
    commits = [
        commit
        for commit in asked.follower.history
        if asked.filter.matches(time_line.of_commit(commit).row())
    ]
    plots = time_line.plots(commits, health, asked.situation.now, span)
    data = {"plots": plots, "span": span, "spans": time_line.SPANS}
    return "rates.html.j2", data | {"width": time_line.WIDTH, "height": time_line.HEIGHT}


VIEWS: Mapping[str, View] = {
    "/": _not_ready,
    "/map": _map,
    **{f"/{name}": _list for name in LISTS},
    "/demand": _demand,
    "/release": _release,
    "/timeline": _timeline,
    "/overrides": _overrides,
    "/rates": _rates,
}
