"""The kinds of things that ``demandops get`` lists: their data, columns and filters."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime, timedelta

from demandops.cli.json_output import (
    Json,
    claim_data,
    lease_data,
    override_data,
    release_data,
    time_data,
    time_text,
)
from demandops.cli.output import version_lines
from demandops.cli.table import Cell, Column
from demandops.cli.views.proposal_list import proposals
from demandops.config.durations import duration_text, relative
from demandops.config.override import parse_time
from demandops.demand.lease import Lease
from demandops.plan.views import demand_list, node_list, release_causes
from demandops.plan.views.bookkeeping import bookkeeping
from demandops.plan.views.override_report import override_report
from demandops.render.changes.override_state import override_state
from demandops.staterepo.load.snapshot import Snapshot
from demandops.staterepo.reader import Reader

Values = Callable[[Json], Iterable[str]]


@dataclass(frozen=True, slots=True)
class Source:
    repo: Reader
    snapshot: Snapshot
    now: datetime
    not_rendered: Collection[str] = ()  # files that a generator has yet to write or remove


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of thing: its items, each with a ``name``, and how they are shown.

    ``cells`` returns an item's cells, first for ``columns`` and then for ``wide``, which only ``-o
    wide`` shows. ``filters`` maps an option to a function from an item to values. An item is listed
    if the option matches one of the values.
    """

    items: Callable[[Source], list[Json]]
    columns: Sequence[Column]
    cells: Callable[[Json, datetime], Sequence[Cell]]
    wide: Sequence[Column]
    filters: Mapping[str, Values] = field(default_factory=dict)


def _demands(source: Source) -> list[Json]:
    return [
        {
            **asdict(demand),
            "state": _now(demand.state, demand.lease, source.now),
            "since": time_data(demand.since),
            "lease": lease_data(demand.lease),
        }
        for demand in demand_list.demands(source.snapshot.state)
    ]


def _now(state: str, lease: Lease | None, now: datetime) -> str:
    return "overdue" if state == "held" and lease and lease.has_ended(now) else state


def _leases(source: Source) -> list[Json]:
    leased = [demand for demand in _demands(source) if demand["lease"]]
    # "~" sorts a lease that has not started behind every time
    return sorted(leased, key=lambda demand: (demand["lease"]["until"] or "~", demand["name"]))


def _nodes(source: Source) -> list[Json]:
    world = source.snapshot.state
    return [
        {**asdict(node), "position": node.position.model_dump() if node.position else None}
        for node in node_list.nodes(world, release_causes.releases(world))
    ]


def _services(source: Source) -> list[Json]:
    world = source.snapshot.state
    return [
        {
            "name": name,
            "domains": demand_list.domains_of([service.node], world.config),
            **asdict(service),
        }
        for name, service in bookkeeping(world).services.items()
    ]


def _connections(source: Source) -> list[Json]:
    world = source.snapshot.state
    return [
        {
            "name": name,
            "domains": demand_list.domains_of([each.source, each.target], world.config),
            **asdict(each),
        }
        for name, each in bookkeeping(world).connections.items()
    ]


def _claims(source: Source) -> list[Json]:
    world = source.snapshot.state
    claims = sorted(world.ledger, key=lambda claim: (str(claim.subject), claim.demand))
    return [
        {
            "name": (data := claim_data(claim))["file"],
            "state": _now(demand_list.state_of(claim, world), claim.lease, source.now),
            "nodes": (nodes := demand_list.nodes_of(claim)),
            "domains": demand_list.domains_of(nodes, world.config),
            **data,
        }
        for claim in claims
    ]


def _overrides(source: Source) -> list[Json]:
    return [
        {
            **override_data(entry.override),
            "state": override_state(entry, source.snapshot.state, source.not_rendered),
            "releases": [release_data(release) for release in entry.releases],
            "claims": [claim_data(claim) for claim in entry.claims],
        }
        for entry in override_report(source.snapshot.state, source.now)
    ]


def _when(time: str | None, now: datetime) -> str:
    return relative(parse_time(time), now) if time else ""


def _absolute_time(time: str | None) -> str:
    return time_text(time).removesuffix(" UTC") if time else ""


def _lease_text(lease: Json | None, now: datetime) -> str:
    if lease is None:
        return ""
    if not lease["until"]:
        return "not started"
    end = parse_time(lease["until"])
    released = end + timedelta(seconds=lease["slack"])
    if end >= now:
        return f"ends {relative(end, now)}"
    then = "waits for a generator" if released < now else f"released {relative(released, now)}"
    return f"ended {relative(end, now)}, {then}"


def effect_words(override: Json) -> list[str]:
    shown = ("version", "replicas", "node")
    listed = ("images", "values")
    return [
        f"{name} {value}"
        if name in shown
        else f"{name} {', '.join(value)}"
        if name in listed
        else name
        for name, value in override["effects"].items()
    ]


def _override_targets(item: Json) -> list[str]:
    subjects = (claim["subject"] for claim in item["claims"])
    claims = (f"{subject['kind']} {subject['id']}" for subject in subjects)
    return [*dict.fromkeys((*(release["name"] for release in item["releases"]), *claims))]


def _key(name: str) -> Values:
    def values(item: Json) -> Iterable[str]:
        value = item[name]
        return [value] if isinstance(value, str) else value or ()

    return values


_COMMON = {"node": _key("nodes"), "requester": _key("requesters"), "domain": _key("domains")}
_SINCE = Column("Since (UTC)")

KINDS: dict[str, Kind] = {
    "claims": Kind(
        _claims,
        (
            Column("Subject"),
            Column("Requesters", 1, wraps=True),
            Column("State", 2),
            Column("Since", 3),
            Column("Lease", 4, wraps=True),
            Column("Demand", 5),
        ),
        lambda item, now: (
            f"{item['subject']['kind']} {item['subject']['id']}",
            ", ".join(item["requesters"]),
            item["state"],
            _when(item["since"], now),
            _lease_text(item["lease"], now),
            item["demand"],
            item["request"],
            _absolute_time(item["since"]),
            item["file"],
        ),
        (Column("Request"), _SINCE, Column("File")),
        _COMMON
        | {
            "application": lambda item: (
                [item["subject"]["id"]] if item["subject"]["kind"] == "application" else []
            )
        },
    ),
    "connections": Kind(
        _connections,
        (
            Column("Connection"),
            Column("Type", 2),
            Column("From", 1),
            Column("To", 1),
            Column("Requesters", 3, wraps=True),
        ),
        lambda item, now: (
            item["name"],
            item["type"],
            item["source"],
            item["target"],
            ", ".join(item["requesters"]),
            list(item["topics"]),
        ),
        (Column("Topics"),),
        _COMMON | {"node": lambda item: [item["source"], item["target"]]},
    ),
    "demands": Kind(
        _demands,
        (
            Column("Demand"),
            Column("State", 3),
            Column("Requesters", 1, wraps=True),
            Column("Holds", 2),
            Column("Since", 5),
            Column("Lease", 4, wraps=True),
        ),
        lambda item, now: (
            item["name"],
            item["state"],
            ", ".join(item["requesters"]),
            [*item["applications"], *item["connections"]],
            _when(item["since"], now),
            _lease_text(item["lease"], now),
            item["requests"],
            item["nodes"],
            _absolute_time(item["since"]),
            item["suspended_by"],
        ),
        (Column("Requests"), Column("Nodes"), _SINCE, Column("Suspended by")),
        _COMMON | {"application": _key("applications")},
    ),
    "leases": Kind(
        _leases,
        (
            Column("Demand"),
            Column("Requesters", 2, wraps=True),
            Column("Term", 3),
            Column("Ends", 1, wraps=True),
        ),
        lambda item, now: (
            item["name"],
            ", ".join(item["requesters"]),
            duration_text(item["lease"]["seconds"]),
            _lease_text(item["lease"], now).removeprefix("ends "),
            _absolute_time(item["lease"]["until"]),
            [*item["applications"], *item["connections"]],
        ),
        (Column("Ends (UTC)"), Column("Holds")),
        _COMMON | {"application": _key("applications")},
    ),
    "nodes": Kind(
        _nodes,
        (
            Column("Node"),
            Column("Type", 2),
            Column("Domain", 3),
            Column("Cluster", 5),
            Column("State", 1),
            Column("Releases", 4),
            Column("Requesters", 6, wraps=True),
        ),
        lambda item, now: (
            item["name"],
            item["type"] or "",
            item["domain"] or "",
            item["cluster"] or "",
            "not in the inventory"
            if item["type"] is None
            else "drained"
            if item["drained"]
            else "open",
            str(len(item["releases"])),
            ", ".join(item["requesters"]),
            item["capabilities"],
            [f"{name}: {json.dumps(value)}" for name, value in item["properties"].items()],
            item["releases"],
        ),
        (Column("Capabilities"), Column("Properties"), Column("Names of releases")),
        {
            "node": _key("name"),
            "requester": _key("requesters"),
            "application": _key("applications"),
            "domain": _key("domain"),
        },
    ),
    "overrides": Kind(
        _overrides,
        (
            Column("Override"),
            Column("State", 1),
            Column("Does", 2, wraps=True),
            Column("Until", 3),
            Column("Owner", 4),
            Column("To", 5),
            Column("Reason", 6, wraps=True),
        ),
        lambda item, now: (
            item["name"],
            item["state"],
            effect_words(item),
            _when(item["until"], now),
            item["owner"],
            _override_targets(item),
            item["reason"],
            str(item["priority"]),
            _absolute_time(item["until"]),
        ),
        (Column("Priority"), Column("Until (UTC)")),
        {
            "node": lambda item: [release["node"] for release in item["releases"]],
            "domain": lambda item: [release["domain"] for release in item["releases"]],
            "requester": lambda item: [
                who for claim in item["claims"] for who in claim["requesters"]
            ],
        },
    ),
    "proposals": Kind(
        lambda source: proposals(source.repo),
        (
            Column("Branch"),
            Column("Commit"),
            Column("Requesters", 1, wraps=True),
            Column("Since", 2),
            Column("What", 3, wraps=True),
            Column("Link", 5),
        ),
        lambda item, now: (
            item["branch"],
            item["commit"][:10],
            ", ".join(item["requesters"]),
            _when(item["since"], now),
            item["summary"],
            item["link"] or "",
            item["demands"],
            _absolute_time(item["since"]),
        ),
        (Column("Demands"), _SINCE),
        {"requester": _key("requesters")},
    ),
    "services": Kind(
        _services,
        (
            Column("Service"),
            Column("Kind", 4),
            Column("Version", 5),
            Column("Node", 1),
            Column("For", 3, wraps=True),
            Column("Requesters", 2, wraps=True),
        ),
        lambda item, now: (
            item["name"],
            item["service"],
            version_lines(item),
            item["node"],
            item["source"] or item["applications"],
            ", ".join(item["requesters"]),
            [topic for topics in item["inputs"].values() for topic in topics],
            [f"{name} = {value}" for name, value in item["parameters"].items()],
        ),
        (Column("Takes in"), Column("Parameters")),
        _COMMON | {"node": _key("node"), "application": _key("applications")},
    ),
}
