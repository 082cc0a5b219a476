"""The lists of the page, and the table that shows them."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Any, TypeAlias, TypeVar

from demandops.base.naming import SubjectKind
from demandops.decide.planning.planner import connection_topics
from demandops.model.config.base_model import duration_text
from demandops.model.ledger.claim import Claim, requesters_of
from demandops.model.ledger.ledger import World
from demandops.model.ledger.records import WaitingDemand
from demandops.model.release import ServiceRelease
from demandops.views import demand_lists
from demandops.views.source import RANKS, WORDS, Source, word_of, worst_word

# ---- lists that can be filtered, sorted and paged, as plain values ----

# How many rows a page of a list has at most.
PAGE = 100


@dataclass(frozen=True, slots=True)
class Part:
    text: str
    view: str = ""  # to which it links, with parameters
    params: Mapping[str, str] = field(default_factory=dict)


Text: TypeAlias = "str | int | Part"
Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Cell:
    parts: tuple[Part, ...] = ()
    time: datetime | None = None  # instead of texts
    tone: str = ""  # the color
    order: float | str | None = None  # by default the time or the first text

    @property
    def rank(self) -> tuple[bool, float, str]:
        # in ascending order, empty cells come last
        if (order := self.order) is None:
            order = self.time.timestamp() if self.time else self.parts[0].text if self.parts else ""
        if isinstance(order, str):
            return order == "", 0.0, order.casefold()
        return False, float(order), ""


@dataclass(frozen=True)
class Row:
    cells: Mapping[str, Cell]  # by column
    hidden: Mapping[str, Sequence[str]] = field(default_factory=dict)  # only filters search these

    @cached_property
    def texts(self) -> dict[str, tuple[str, ...]]:
        """The texts of each field; lower case, because filters ignore case."""
        all_texts = {
            key: tuple(part.text for part in cell.parts) for key, cell in self.cells.items()
        }
        for key, texts in self.hidden.items():
            all_texts[key] = (*all_texts.get(key, ()), *texts)
        return {key: tuple(text.casefold() for text in texts) for key, texts in all_texts.items()}

    @cached_property
    def all_texts(self) -> str:
        return "\n".join(text for texts in self.texts.values() for text in texts)


def cell(*texts: Text, tone: str = "", order: float | str | None = None) -> Cell:
    parts = (text if isinstance(text, Part) else Part(str(text)) for text in texts)
    return Cell(tuple(part for part in parts if part.text), tone=tone, order=order)


class Filter:
    """A search text for rows: a row matches if it contains all words of the text.

    The word ``node:edge`` matches if the field ``node`` contains ``edge``; ``node=edge`` matches if
    a text of the field is exactly ``edge``. If the row has no such field, the word is searched in
    all texts. Quotes join words. Upper and lower case are the same.
    """

    def __init__(self, text: str) -> None:
        try:
            words = shlex.split(text)
        except ValueError:  # the text has a quote that is not closed
            words = text.split()
        self._words = [word.casefold() for word in words]

    def __bool__(self) -> bool:
        return bool(self._words)

    def matches(self, row: Row) -> bool:
        def has(word: str) -> bool:
            for sign in ":=":
                key, separator, wanted = word.partition(sign)
                if separator and key in row.texts:
                    texts = row.texts[key]
                    return wanted in texts if sign == "=" else any(wanted in text for text in texts)
            return word in row.all_texts

        return all(map(has, self._words))


def exactly(key: str, value: str) -> str:
    return shlex.quote(f"{key}={value}")


def page_of(items: Sequence[Item], page: int, size: int) -> tuple[Sequence[Item], int, int]:
    pages = max(1, -(-len(items) // size))
    page = min(max(page, 1), pages)
    return items[(page - 1) * size : page * size], page, pages


# ---- the lists: demands, services, connections and leases ----

Values: TypeAlias = "tuple[Any, ...]"


class ListKind:
    title: str
    about: str
    columns: Mapping[str, str]  # the titles, by the keys of a row's cells
    entries: Callable[[Source], Iterator[tuple[str, Values]]]  # each with its id
    # Makes a row of the values of an entry. While these stay the same, it is called again only if
    # the configuration or the overrides have changed.
    row: Callable[..., Row]


def _release_part(name: str) -> Part:
    return Part(name, "release", {"name": name})


def _demand_part(id: str) -> Part:
    return Part(id, "demand", {"id": id})


def _health_cell(word: str) -> Cell:
    return cell(word, tone=WORDS[word], order=RANKS[word])


def _linked(view: str, key: str, values: Iterable[str]) -> Cell:
    return cell(*(Part(value, view, {"q": exactly(key, value)}) for value in values))


def _requesters(requesters: Iterable[str]) -> Cell:
    return _linked("demands", "requester", requesters)


def _columns(keys_and_titles: str) -> dict[str, str]:
    return dict(column.split("|") for column in keys_and_titles.split(", "))


class DemandsList(ListKind):
    title = "Demands"
    about = "What requesters hold, until they release it or its lease ends."
    columns = _columns(
        "demand|Demand, health|Health, requester|Requesters, application|Applications, "
        "connection|Connections, since|Since, lease|Lease until, request|Request"
    )

    def entries(self, now: Source) -> Iterator[tuple[str, Values]]:
        for id, claims in now.claims_of_demands.items():
            releases = now.releases_of_demands.get(id, [])
            yield id, (claims, releases, worst_word(map(now.status, releases)))
        for demand in now.state.ledger.waiting.values():
            yield f"waiting {demand.demand}", (demand, [], "waiting")

    def row(
        self, world: World, holds: list[Claim] | WaitingDemand, releases: list[str], word: str
    ) -> Row:
        if isinstance(holds, WaitingDemand):
            held = demand_lists.waiting_demand(holds)
        else:
            held = demand_lists.held_demand(holds, world)
        health = _health_cell(word)
        if held.state == "suspended":
            health = cell("suspended", tone="bad", order=0.0)
        elif held.state == "waiting":
            health = cell("waits for room", tone="busy", order=RANKS["waiting"])
        return Row(
            {
                "demand": cell(_demand_part(held.name)),
                "request": cell(*held.requests),
                "requester": _requesters(held.requesters),
                "application": _linked("services", "application", held.applications),
                "connection": _linked("connections", "connection", held.connections),
                "since": Cell(time=held.since),
                "lease": Cell(time=held.lease.until if held.lease else None),
                "health": health,
            },
            {"release": releases, "node": held.nodes},
        )


class ServicesList(ListKind):
    title = "Services"
    about = "One row for each Helm release: a service on a node, shared by all who need it."
    columns = _columns(
        "release|Release, health|Health, service|Service, node|Node, cluster|Cluster, "
        "application|For, version|Version, requester|Requesters"
    )

    def entries(self, now: Source) -> Iterator[tuple[str, Values]]:
        for release, _ in now.targets:
            if isinstance(release, ServiceRelease):
                name = release.name
                claims = now.claims_of_releases[name]
                yield name, (release, claims, word_of(now.status(name)))

    def row(self, world: World, release: ServiceRelease, claims: list[Claim], word: str) -> Row:
        return Row(
            {
                "release": cell(_release_part(release.name)),
                "service": cell(release.key.service),
                "node": _linked("services", "node", [release.node.id]),
                "cluster": cell(release.node.cluster),
                "application": _linked("services", "application", release.applications),
                "version": cell(release.version.name or release.chart.version),
                "requester": _requesters(release.requesters),
                "health": _health_cell(word),
            },
            {
                "demand": [*dict.fromkeys(claim.demand for claim in claims)],
                "type": [release.node.type],
            },
        )


class ConnectionsList(ListKind):
    title = "Connections"
    about = "Topics that are carried from one node to another."
    columns = _columns(
        "connection|Connection, health|Health, by|By, from|From, to|To, topic|Topics, "
        "requester|Requesters, release|Releases"
    )

    def entries(self, now: Source) -> Iterator[tuple[str, Values]]:
        ledger = now.active.ledger
        clients_of: dict[str, list[str]] = {}
        for name, release in now.releases.items():
            if not isinstance(release, ServiceRelease):
                for id in release.connections:
                    clients_of.setdefault(id, []).append(name)
        for id in ledger.subjects(SubjectKind.CONNECTION):
            claims, clients = ledger.connection_claims(id), clients_of.get(id, [])
            if claims:  # at least one claim is not suspended
                yield id, (claims, clients, worst_word(map(now.status, clients)))

    def row(self, world: World, claims: tuple[Claim, ...], clients: list[str], word: str) -> Row:
        held = claims[0].connection
        return Row(
            {
                "connection": cell(held.id),
                "by": cell(held.type.word if held.type else ""),
                "from": _linked("connections", "from", [held.source]),
                "to": _linked("connections", "to", [held.target]),
                "topic": cell(
                    *(
                        route.source if same else f"{route.source} as {route.target}"
                        for route in connection_topics(claims)
                        for same in [route.source == route.target]
                    )
                ),
                "requester": _requesters(requesters_of(claims)),
                "release": cell(*map(_release_part, clients)),
                "health": _health_cell(word),
            },
            {"demand": [claim.demand for claim in claims], "node": [held.source, held.target]},
        )


class LeasesList(ListKind):
    title = "Leases"
    about = "Claims that end unless their requester renews them. The first to end comes first."
    columns = _columns(
        "ends|Ends, subject|Holds, kind|Kind, demand|Demand, requester|Requesters, "
        "term|Term, slack|Slack"
    )

    def entries(self, now: Source) -> Iterator[tuple[str, Values]]:
        for claim in now.state.ledger:
            if claim.lease is not None:
                yield f"{claim.subject} {claim.demand}", (claim,)

    def row(self, world: World, claim: Claim) -> Row:
        lease = claim.lease
        assert lease is not None  # noqa: S101 - only claims with a lease are listed
        return Row(
            {
                "ends": Cell(time=lease.until),
                "subject": cell(claim.subject.id),
                "kind": cell(claim.subject.kind.value[:-1]),
                "demand": cell(_demand_part(claim.demand)),
                "requester": _requesters(claim.requesters),
                "term": cell(duration_text(lease.seconds), order=float(lease.seconds)),
                "slack": cell(duration_text(lease.slack), order=float(lease.slack)),
            },
            {"node": demand_lists.nodes_of(claim)},
        )


LISTS: dict[str, ListKind] = {
    "demands": DemandsList(),
    "services": ServicesList(),
    "connections": ConnectionsList(),
    "leases": LeasesList(),
}


def rows_of(now: Source, name: str) -> list[Row]:
    kind = LISTS[name]
    statuses, shown = now.rows.get(name, (None, {}))
    # the follower makes a new mapping of statuses whenever it looks, so the same mapping means that
    # nothing has changed
    if statuses is not now.statuses:
        rows: dict[str, tuple[Values, Row]] = {}
        for id, values in kind.entries(now):
            before = shown.get(id)
            if before is None or before[0] != values:
                before = values, kind.row(now.state, *values)
            rows[id] = before
        now.rows[name], shown = (now.statuses, rows), rows
    return [row for _, row in shown.values()]
