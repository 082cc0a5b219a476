"""``demandops get``: the kinds of things that it lists, and their columns."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from typing import ClassVar

import click

from demandops.base import settings, strict_yaml
from demandops.base.errors import InvalidInput, fault, suggestion
from demandops.base.naming import SubjectKind
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.base.settings import MAIN_BRANCH
from demandops.cli import json_output
from demandops.cli.json_output import Json, claim_data, time_data, time_text
from demandops.cli.output import (
    at_option,
    errors,
    painted,
    version_lines,
    warn_of_not_rendered,
)
from demandops.cli.queries.diff import loaded
from demandops.cli.table import CellOf, Column, Table, column, joined, table_of
from demandops.cli.target import name_options, names_of, state_repo_option
from demandops.decide.bookkeeping import bookkeeping, carried_topics
from demandops.decide.override_report import override_report, override_state
from demandops.model.config.base_model import duration_text, parse_time, relative
from demandops.model.config.policy import matches
from demandops.model.config.repo_settings import Proposals
from demandops.model.demand.demand import Lease
from demandops.model.ledger.ledger import World
from demandops.repo import reader
from demandops.repo.forge import ForgeError, forge_for
from demandops.repo.git.repository import RemoteAway
from demandops.repo.load.snapshot import Snapshot
from demandops.repo.reader import Reader
from demandops.repo.write.proposal_branch import pending_proposals
from demandops.views import demand_lists, release_causes

# ---- the kinds of things: their data, columns and filters ----

Values = Callable[[Json], Iterable[str]]


@dataclass(frozen=True, slots=True)
class Source:
    repo: Reader
    snapshot: Snapshot
    now: datetime
    not_rendered: Collection[str] = ()  # files that a generator has yet to write or remove


class Kind:
    items: Callable[[Source], list[Json]]  # each with a ``name``
    columns: Sequence[Column]
    wide: Sequence[Column]  # further columns for `-o wide`
    # An item is listed if the option matches one of the values that its filter returns.
    filters: ClassVar[Mapping[str, Values]]

    def table(self, items: Iterable[Json], now: datetime, *, wide: bool = False) -> Table:
        shown = [*self.columns, *(self.wide if wide else ())]
        return table_of(shown, items, now, whole=wide)


def _state_now(state: str, lease: Lease | None, now: datetime) -> str:
    return "overdue" if state == "held" and lease and lease.has_ended(now) else state


def _lease_text(item: Json, now: datetime) -> str:
    if (lease := item["lease"]) is None:
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


def _node_state(item: Json, now: datetime) -> str:
    if item["type"] is None:  # only claims name it
        return "not in the inventory"
    return "drained" if item["drained"] else "open"


def _holds(item: Json, now: datetime) -> list[str]:
    return [*item["applications"], *item["connections"]]


def _asked_topics(topics: Mapping[str, list[str]], item: Json) -> list[str]:
    # a topic is followed by its requesters if the item has others too
    return [
        topic if who == item["requesters"] else f"{topic} ({', '.join(who)})"
        for topic, who in topics.items()
    ]


def _ago(key: str) -> CellOf:
    return lambda item, now: relative(parse_time(item[key]), now) if item[key] else ""


def _utc(key: str) -> CellOf:
    return lambda item, now: time_text(item[key]).removesuffix(" UTC") if item[key] else ""


def _key(name: str) -> Values:
    def values(item: Json) -> Iterable[str]:
        value = item[name]
        return [value] if isinstance(value, str) else value or ()

    return values


_COMMON = {"node": _key("nodes"), "requester": _key("requesters"), "domain": _key("domains")}


class _Claims(Kind):
    columns = (
        column(
            "Subject",
            lambda item, now: [
                "{kind} {id}".format(**item["subject"]),
                *(f"held for {id}" for id in item["held_for"]),
            ],
        ),
        column("Requesters", joined("requesters"), 1, wraps=True),
        column("State", "state", 2),
        column("Since", _ago("since"), 3),
        column("Lease", _lease_text, 4, wraps=True),
        column("Demand", "demand", 5),
    )
    wide = (
        column("Request", "request"),
        column("Since (UTC)", _utc("since")),
        column("File", "file"),
    )
    filters = _COMMON | {
        "application": lambda item: (
            [item["subject"]["id"]] if item["subject"]["kind"] == "application" else []
        )
    }

    def items(self, source: Source) -> list[Json]:
        world = source.snapshot.state
        claims = sorted(world.ledger, key=lambda claim: (str(claim.subject), claim.demand))
        return [
            {
                "name": (data := claim_data(claim))["file"],
                "state": _state_now(demand_lists.state_of(claim, world), claim.lease, source.now),
                "nodes": (nodes := demand_lists.nodes_of(claim)),
                "domains": demand_lists.domains_of(nodes, world.config),
                **data,
            }
            for claim in claims
        ]


class _Connections(Kind):
    columns = (
        column("Connection", "name"),
        column("Type", "type", 2),
        column("From", "source", 1),
        column("To", "target", 1),
        column("Requesters", joined("requesters"), 3, wraps=True),
    )
    wide = (column("Topics", lambda item, now: _asked_topics(carried_topics(item), item), 4),)
    filters = _COMMON | {"node": lambda item: [item["source"], item["target"]]}

    def items(self, source: Source) -> list[Json]:
        world = source.snapshot.state
        return [
            {
                "name": name,
                "domains": demand_lists.domains_of(
                    [entry["source"], entry["target"]], world.config
                ),
                **entry,
            }
            for name, entry in bookkeeping(world)["connections"].items()
        ]


class _Demands(Kind):
    columns = (
        column("Demand", "name"),
        column("State", "state", 3),
        column("Requesters", joined("requesters"), 1, wraps=True),
        column("Holds", _holds, 2),
        column("Since", _ago("since"), 5),
        column("Lease", _lease_text, 4, wraps=True),
    )
    wide = (
        column("Requests", "requests"),
        column("Nodes", "nodes"),
        column("Since (UTC)", _utc("since")),
        column("Suspended by", "suspended_by"),
    )
    filters = _COMMON | {"application": _key("applications")}

    def items(self, source: Source) -> list[Json]:
        return [
            {
                **asdict(demand),
                "state": _state_now(demand.state, demand.lease, source.now),
                "since": time_data(demand.since),
                "lease": json_output.lease_data(demand.lease),
            }
            for demand in demand_lists.demands(source.snapshot.state)
        ]


class _Leases(Kind):
    columns = (
        column("Demand", "name"),
        column("Requesters", joined("requesters"), 2, wraps=True),
        column("Term", lambda item, now: duration_text(item["lease"]["seconds"]), 3),
        column(
            "Ends",
            lambda item, now: _lease_text(item, now).removeprefix("ends "),
            1,
            wraps=True,
        ),
    )
    wide = (
        column("Ends (UTC)", lambda item, now: _utc("until")(item["lease"], now)),
        column("Holds", _holds),
    )
    filters = _COMMON | {"application": _key("applications")}

    def items(self, source: Source) -> list[Json]:
        leased = [demand for demand in KINDS["demands"].items(source) if demand["lease"]]
        # "~" sorts a lease that has not started behind every time
        return sorted(leased, key=lambda demand: (demand["lease"]["until"] or "~", demand["name"]))


class _Nodes(Kind):
    columns = (
        column("Node", "name"),
        column("Type", "type", 2),
        column("Domain", "domain", 3),
        column("Cluster", "cluster", 5),
        column("State", _node_state, 1),
        column("Releases", lambda item, now: str(len(item["releases"])), 4),
        column("Requesters", joined("requesters"), 6, wraps=True),
    )
    wide = (
        column("Capabilities", "capabilities"),
        column(
            "Properties",
            lambda item, now: [
                f"{name}: {json.dumps(value)}" for name, value in item["properties"].items()
            ],
        ),
        column("Names of releases", "releases"),
    )
    filters = _COMMON | {
        "node": _key("name"),
        "application": _key("applications"),
        "domain": _key("domain"),
    }

    def items(self, source: Source) -> list[Json]:
        world = source.snapshot.state
        return demand_lists.nodes(world, release_causes.releases(world))


class _Overrides(Kind):
    columns = (
        column("Override", "name"),
        column("State", "state", 1),
        column("Does", lambda item, now: effect_words(item), 2, wraps=True),
        column("Until", _ago("until"), 3),
        column("Owner", "owner", 4),
        column(
            "To",
            lambda item, now: [
                *dict.fromkeys(release["name"] for release in item["releases"]),
                *dict.fromkeys("{kind} {id}".format(**c["subject"]) for c in item["claims"]),
            ],
            5,
        ),
        column("Reason", "reason", 6, wraps=True),
    )
    wide = (
        column("Priority", lambda item, now: str(item["priority"])),
        column("Until (UTC)", _utc("until")),
    )
    filters = _COMMON | {
        "node": lambda item: [release["node"] for release in item["releases"]],
        "domain": lambda item: [release["domain"] for release in item["releases"]],
        "requester": lambda item: [who for claim in item["claims"] for who in claim["requesters"]],
    }

    def items(self, source: Source) -> list[Json]:
        return [
            {
                **json_output.override_data(entry.override),
                "state": override_state(entry, source.snapshot.state, source.not_rendered),
                "releases": [json_output.release_data(release) for release in entry.releases],
                "claims": [claim_data(claim) for claim in entry.claims],
            }
            for entry in override_report(source.snapshot.state, source.now)
        ]


class _Proposals(Kind):
    columns = (
        column("Branch", "branch"),
        column("Commit", lambda item, now: item["commit"][:10]),
        column("Requesters", joined("requesters"), 1, wraps=True),
        column("Since", _ago("since"), 2),
        column("What", "summary", 3, wraps=True),
        column("Link", "link", 5),
    )
    wide = (column("Demands", "demands"), column("Since (UTC)", _utc("since")))
    filters: ClassVar[Mapping[str, Values]] = {"requester": _key("requesters")}

    def items(self, source: Source) -> list[Json]:
        repo, pending = source.repo, list(pending_proposals(source.repo.repository))
        # without a forge, a token or an answer, the proposals are listed without links
        token_file, forge = settings.forge_token_file(), None
        if pending and token_file is not None:
            try:
                configured = repo.config().repo_settings.proposals
            except InvalidInput:
                configured = Proposals()
            try:
                forge = forge_for(configured, token_file)
            except ForgeError as error:
                errors.print(f"warning: {error}")
        rows = []
        for proposal in pending:
            link = None
            try:
                request = forge.find(proposal.branch, MAIN_BRANCH) if forge else None
                link = request.link if request else None
            except ForgeError as error:
                errors.print(f"warning: {error}")
            since = time_data(proposal.since)
            rows.append({"name": proposal.branch, **asdict(proposal), "since": since, "link": link})
        return rows


class _Services(Kind):
    columns = (
        column("Service", "name"),
        column("Kind", "service", 4),
        column("Version", lambda item, now: version_lines(item), 5),
        column("Node", "node", 1),
        column("For", lambda item, now: item["source"] or item["applications"], 3, wraps=True),
        column("Requesters", joined("requesters"), 2, wraps=True),
    )
    wide = (
        column(
            "Takes in",
            lambda item, now: [
                line for topics in item["inputs"].values() for line in _asked_topics(topics, item)
            ],
            6,
        ),
        column(
            "Parameters",
            lambda item, now: [f"{name} = {value}" for name, value in item["parameters"].items()],
            7,
        ),
    )
    filters = _COMMON | {"node": _key("node"), "application": _key("applications")}

    def items(self, source: Source) -> list[Json]:
        world = source.snapshot.state
        return [
            {
                "name": name,
                "domains": demand_lists.domains_of([service["node"]], world.config),
                **service,
            }
            for name, service in bookkeeping(world)["services"].items()
        ]


KINDS: dict[str, Kind] = {
    "claims": _Claims(),
    "connections": _Connections(),
    "demands": _Demands(),
    "leases": _Leases(),
    "nodes": _Nodes(),
    "overrides": _Overrides(),
    "proposals": _Proposals(),
    "services": _Services(),
}


# ---- the command ----

FILTERS = ("node", "requester", "application", "domain")
_OF_NOTE = ("drained", "expired", "held back", "matches nothing", "not rendered yet", "overdue")
_COLORS = {
    **dict.fromkeys((*_OF_NOTE, "partly suspended", "suspended", "waiting"), "yellow"),
    **{"held": "green", "in force": "green", "not in the inventory": "red"},
}


def _kind_named(ctx: click.Context, param: click.Parameter, value: str | None) -> str:
    if value is None:
        raise click.UsageError(f"Missing argument 'KIND': one of {', '.join(KINDS)}", ctx)
    for name in (value, f"{value}s"):
        if name in KINDS:
            return name
    raise click.BadParameter(f"there is no kind '{value}'{suggestion(value, KINDS)}")


def _item_names(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    kind = ctx.params.get("kind") or ""
    same = ("connections", "demands", "nodes", "overrides", "proposals")
    kinds = {"leases": "demands", "services": "releases"} | {name: name for name in same}
    return names_of(kinds[kind])(ctx, param, incomplete) if kind in kinds else []


@click.command()
@click.argument(
    "kind",
    required=False,
    callback=_kind_named,
    shell_complete=lambda ctx, param, text: [name for name in KINDS if name.startswith(text)],
    metavar="KIND",
)
@click.argument("names", nargs=-1, metavar="[NAME…]", shell_complete=_item_names)
@state_repo_option
@name_options(
    {
        name: f"List only items of this {name}; * matches any text, ? one character."
        for name in FILTERS
    },
    metavar="NAME",
)
@at_option
@click.option(
    "-w",
    "--watch",
    is_flag=True,
    help="Print the list again when a new commit or proposal changes it.",
)
@json_output.output_formats("text", "wide", "name", "json", "yaml")
def get(
    kind: str,
    names: tuple[str, ...],
    state_repo: str,
    at: str | None,
    watch: bool,
    output: str,
    **filters: str | None,
) -> None:
    """List demands, nodes, services, overrides and so on.

    KIND is demands, leases, nodes, services, connections, claims, proposals or overrides. A
    proposal is a branch that a person merges to approve its demands, or deletes to refuse them.
    NAME and the filters may be patterns with * and ?. If you give several filters, an item must
    match all of them. The state of an override is `in force`, `not rendered yet` (a generator has
    yet to write the files that the override changes), `held back` (another override with hold keeps
    these files as they are), `expired` or `matches nothing`.

    \b
    Examples:
      demandops get demands --requester vehicle00
      demandops get services -o wide
      demandops get nodes --domain perception -o name
      demandops get leases --watch
      demandops get overrides --at 2h -o json
    """
    if watch and at:
        raise click.UsageError("--watch follows the newest commit, so leave out --at")
    listed = KINDS[kind]
    wanted = {name: value for name, value in filters.items() if value is not None}
    for name in sorted(wanted.keys() - listed.filters.keys()):
        can = ", ".join(f"--{option}" for option in FILTERS if option in listed.filters)
        raise click.UsageError(f"{kind} have no --{name}; they can be filtered by {can}")
    with reader.opened(state_repo) as repo:
        source = _read_source(repo, at)
        items = listed.items(source)
        _refuse_unknown(listed, items, source.snapshot.state, names, wanted)
        items = _matching(listed, items, names, wanted)
        _print_list(kind, source, items, output, watch)
        while watch:
            # each look at a remote is a fetch
            REAL.sleep(1.0 if repo.repository.always_current else 10.0)
            try:
                is_same = repo.refresh() == str(source.snapshot.commit)
            except RemoteAway as error:
                errors.print(f"warning: {error}")
                is_same = True
            if is_same and kind != "proposals":  # a proposal is a branch, and no commit on main
                continue
            source = _read_source(repo, None)
            before, items = items, _matching(listed, listed.items(source), names, wanted)
            if items != before:
                _print_list(kind, source, items, output, watch)


def _read_source(repo: Reader, at: str | None) -> Source:
    snapshot = loaded(repo, at)
    not_rendered = repo.not_rendered(snapshot) if at is None else frozenset()
    warn_of_not_rendered(not_rendered)
    return Source(repo, snapshot, REAL.now(), not_rendered)


def _matching(
    kind: Kind, items: Iterable[Json], names: tuple[str, ...], wanted: dict[str, str]
) -> list[Json]:
    return [
        item
        for item in items
        if (not names or matches(item["name"], names))
        and all(
            any(matches(value, (pattern,)) for value in kind.filters[name](item))
            for name, pattern in wanted.items()
        )
    ]


def _refuse_unknown(
    kind: Kind, items: list[Json], world: World, names: tuple[str, ...], wanted: dict[str, str]
) -> None:
    # what matches nothing is probably misspelled
    # a filter may match no item if it names something that exists, such as a node without demands
    existing: dict[str, Iterable[str]] = {
        "node": {*world.config.nodes, *world.ledger.indexed_names("node")},
        "domain": world.config.domains,
        "requester": world.ledger.indexed_names("requester"),
        "application": world.ledger.subjects(SubjectKind.APPLICATION),
    }
    asked = [(name, "", {item["name"] for item in items}) for name in names]
    for name, pattern in wanted.items():
        listed = (value for item in items for value in kind.filters[name](item))
        asked.append((pattern, f"--{name}", {*existing[name], *listed}))
    faults = [
        fault(option, f"nothing is called {quoted(pattern)}{suggestion(pattern, candidates)}")
        for pattern, option, candidates in asked
        if not any(matches(name, (pattern,)) for name in candidates)
    ]
    if faults:
        raise InvalidInput(faults)


def _print_list(kind: str, source: Source, items: list[Json], output: str, watch: bool) -> None:
    commit = str(source.snapshot.commit)
    plain = json.loads(json.dumps({"kind": kind, "commit": commit, "items": items}))
    if output == "json" and watch:
        click.echo(json_output.json_text(plain))
    elif output == "json":
        json_output.print_json(plain)
    elif output == "yaml":
        click.echo(("---\n" if watch else "") + strict_yaml.dump(plain), nl=False)
    elif output == "name":
        json_output.show(output, None, [item["name"] for item in items])
    else:
        table = KINDS[kind].table(items, source.now, wide=output == "wide")
        table = replace(table, empty=f"no {kind}", styles=_COLORS)
        when = f"{source.now:%H:%M:%S} UTC, " if watch else ""
        note = painted(f"{when}at {commit[:10]}", "dim")
        json_output.show(output, None, [table, *([note] if watch else [])])
