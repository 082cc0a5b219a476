"""``demandops log``: the commits of the state repo, all or filtered."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from itertools import islice
from typing import Any

import click

from demandops.base.errors import InvalidInput, StateRepoError, fault, suggestion
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL
from demandops.cli.formats import Table, list_table, output_formats, show
from demandops.cli.output import busy
from demandops.cli.queries.diff import resolved
from demandops.cli.target import name_options, state_repo_option
from demandops.repo import reader
from demandops.repo.history import revisions
from demandops.repo.history.commit_log import LogEntry
from demandops.repo.reader import Reader
from demandops.views.kinds import KINDS, event
from demandops.views.vocabulary import commit_data

# The operations that `--operation` accepts. `by-hand` selects the commits by people.
OPERATIONS = (
    *("join", "shutdown", "put", "release", "renew", "expire", "wait", "decommission", "drain"),
    *("follow", "expire-override", "rollback", "reject", "upgrade", "init", "by-hand"),
)

_TRAILERS = {
    "requester": "Requester",
    "application": "Application",
    "connection": "Connection",
    "demand": "Demand-Id",
}


def _time(ctx: click.Context, param: click.Parameter, text: str | None) -> datetime | None:
    if text is None:
        return None
    time = revisions.parse_time(text, REAL.now(), end=param.name == "until")
    if time is None:
        raise click.BadParameter(f"'{text}' is not a time; write it like {revisions.TIMES}")
    return time


@click.command()
@click.argument("commit_range", required=False, metavar="[REV|A..B]")
@state_repo_option
@name_options(
    {
        "requester": "List only commits about claims or waiting demands of this requester.",
        "application": "List only commits about this application.",
        "connection": "List only commits about this connection.",
        "node": "List only commits that change a release on this node or a claim that names this "
        "node.",
    },
    metavar="ID",
)
@name_options(
    {"release": "List only commits that changed the file of this release."}, metavar="NAME"
)
@name_options({"demand": "List only commits about this demand."}, metavar="ID")
@click.option(
    "--operation",
    type=click.Choice(OPERATIONS),
    metavar="WORD",
    help=f"List only commits of this operation: {', '.join(OPERATIONS[:-1])}. {OPERATIONS[-1]} "
    "means commits by people.",
)
@click.option(
    "--since",
    callback=_time,
    metavar="TIME",
    help=f"List only commits at or after this time: {revisions.TIMES}.",
)
@click.option(
    "--until", callback=_time, metavar="TIME", help="List only commits at or before this time."
)
@click.option(
    "-n",
    "--max-count",
    type=click.IntRange(1),
    default=None,
    help="List at most this many commits.",
)
@output_formats("text", "wide", "json")
def log(
    commit_range: str | None,
    state_repo: str,
    max_count: int | None,
    output: str,
    **given: Any,  # noqa: ANN401 - the filters
) -> None:
    """List the commits of the state repo, newest first.

    If you give several filters, a commit must match all of them. REV, A and B are commits, or times
    written as for --since. -o wide adds the absolute times, operations, authors and request ids.

    \b
    Examples:
      demandops log -n 10
      demandops log --requester vehicle00 --since 2h
      demandops log --node edge --operation shutdown
      demandops log main~20..main -o wide
    """
    with reader.opened(state_repo) as repo:
        for side in filter(None, (commit_range or "").split("..")):
            resolved(repo, side)
        release, path = given.pop("release"), None
        if release is not None:
            tip = repo.commit((commit_range or "").rpartition("..")[2])
            path = release if "/" in release else repo.release_path(release, tip)
            if path is None:
                raise StateRepoError(
                    f"up to commit {tip[:10]}, there was no release {quoted(release)}; "
                    "`demandops status` lists the current ones"
                )
        commits = repo.log(commit_range, path) if path else repo.log(commit_range)
        wanted = [(_TRAILERS[name], given[name]) for name in _TRAILERS if given[name] is not None]

        def matches(entry: LogEntry) -> bool:
            return (
                all(value in entry.trailers.get(trailer, ()) for trailer, value in wanted)
                and given["operation"] in (None, entry.first("Operation") or "by-hand")
                and (given["since"] is None or entry.time >= given["since"])
                and (given["until"] is None or entry.time <= given["until"])
                # last, because it reads the trees of the commit
                and (given["node"] is None or repo.changes_node(entry.commit, given["node"]))
            )

        with busy("looking through the commits"):
            if not (entries := list(islice(filter(matches, commits), max_count))):
                _refuse_unknown(repo, given)
    table = log_table(entries, REAL.now(), wide=output == "wide")
    rows = [commit_data(entry) for entry in entries]
    show(output, rows, [table if entries else "no commit matches"])


def _refuse_unknown(repo: Reader, given: dict[str, Any]) -> None:
    # a name that no commit is about is probably misspelled
    names: dict[str, set[str]] = {name: set() for name in _TRAILERS if given[name] is not None}
    for entry in repo.log() if names else ():
        for name, values in names.items():
            values.update(entry.trailers.get(_TRAILERS[name], ()))
    faults = [
        fault(
            f"--{name}",
            f"no commit is about {quoted(given[name])}{suggestion(given[name], values)}",
        )
        for name, values in names.items()
        if given[name] not in values
    ]
    if (node := given["node"]) is not None:
        # no commit needs to have changed a node that the inventory has
        nodes = {*repo.snapshot().state.config.nodes}
        if node not in nodes and not any(
            repo.changes_node(entry.commit, node) for entry in repo.log()
        ):
            message = f"there is no node {quoted(node)}{suggestion(node, nodes)}"
            faults.append(fault("--node", message))
    if faults:
        raise InvalidInput(faults)


def log_table(entries: Iterable[LogEntry], now: datetime, *, wide: bool = False) -> Table:
    kind = KINDS["events"]
    return list_table(kind, [kind.row(event(entry)) for entry in entries], now, wide=wide)
