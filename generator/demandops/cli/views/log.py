"""``demandops log``: the commits of the state repo, all or filtered."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from itertools import islice
from typing import Any

import click
from rich.table import Table

from demandops.cli.json_output import commit_data, output_option, show
from demandops.cli.output import state_repo_option
from demandops.errors import StateRepoError
from demandops.quoting import one_line
from demandops.runtime import REAL
from demandops.staterepo import reader
from demandops.staterepo.history import revisions
from demandops.staterepo.history.commit_log import LogEntry
from demandops.staterepo.reader import Reader

_TRAILERS = {
    "requester": "Requester",
    "application": "Application",
    "connection": "Connection",
    "demand": "Demand-Id",
}


def _time(ctx: click.Context, param: click.Parameter, text: str | None) -> datetime | None:
    """Parse the time of --since or --until."""
    if text is None:
        return None
    time = revisions.parse_time(text, REAL.now(), end=param.name == "until")
    if time is None:
        raise click.BadParameter(f"'{text}' is not a time; write it like {revisions.TIMES}")
    return time


@click.command()
@click.argument("commit_range", required=False, metavar="[REV|A..B]")
@state_repo_option
@click.option(
    "--requester", metavar="ID", help="Commits that book or release claims of this requester."
)
@click.option("--application", metavar="ID", help="Commits about this application.")
@click.option("--connection", metavar="ID", help="Commits about this connection.")
@click.option(
    "--node",
    metavar="ID",
    help="Commits that change a release on this node or a claim that names it.",
)
@click.option("--release", metavar="NAME", help="Commits that changed the file of this release.")
@click.option("--demand", metavar="ID", help="Commits about this demand.")
@click.option(
    "--operation",
    metavar="WORD",
    help="Commits of this operation: join, shutdown, put, release, renew, expire, decommission, "
    "follow, expire-override, rollback, upgrade, init; or by-hand.",
)
@click.option(
    "--since",
    callback=_time,
    metavar="TIME",
    help=f"Commits at or after this time: {revisions.TIMES}.",
)
@click.option("--until", callback=_time, metavar="TIME", help="Commits at or before this time.")
@click.option(
    "-n",
    "--max-count",
    type=click.IntRange(1),
    default=None,
    help="List at most this many commits.",
)
@output_option
def log(
    commit_range: str | None,
    state_repo: str,
    max_count: int | None,
    output: str,
    **given: Any,  # noqa: ANN401 - the filters
) -> None:
    """List the commits of the state repo, newest first.

    With several filters, a commit must match all of them. REV, A and B are commits, or times
    written as for --since.
    """
    with reader.opened(state_repo) as repo:
        commits = _walked(repo, commit_range, given.pop("release"))
        entries = list(islice(_matching(repo, commits, **given), max_count))
    text = [_table(entries) if entries else "no commit matches"]
    show(output, [commit_data(entry) for entry in entries], text)


def _walked(repo: Reader, commit_range: str | None, release: str | None) -> Iterable[LogEntry]:
    if release is None:
        return repo.log(commit_range)
    tip = repo.commit((commit_range or "").rpartition("..")[2])
    path = release if "/" in release else repo.release_path(release, tip)
    if path is None:
        raise StateRepoError(
            f"there was never a release '{release}'; `demandops bookkeeping` lists what runs"
        )
    return repo.log(commit_range, path)


def _matching(
    repo: Reader,
    entries: Iterable[LogEntry],
    *,
    node: str | None,
    operation: str | None,
    since: datetime | None,
    until: datetime | None,
    **trailers: str | None,
) -> Iterable[LogEntry]:
    """Return the commits that match every given filter; ``_TRAILERS`` lists the trailers."""
    wanted = [(_TRAILERS[name], value) for name, value in trailers.items() if value is not None]

    def matches(entry: LogEntry) -> bool:
        return (
            all(value in entry.trailers.get(key, ()) for key, value in wanted)
            and operation in (None, entry.first("Operation") or "by-hand")
            and (since is None or entry.time >= since)
            and (until is None or entry.time <= until)
            and (node is None or repo.changes_node(entry.commit, node))
        )

    return filter(matches, entries)


def _table(entries: Iterable[LogEntry]) -> Table:
    table = Table("Commit", "Time (UTC)", "Operation", "Requesters", "What")
    for entry in entries:
        requesters = one_line(", ".join(entry.trailers.get("Requester", ())))
        if entry.first("Operation") == "rollback":
            requesters = f"{entry.author}, for {requesters}"
        table.add_row(
            entry.commit[:10],
            entry.time.strftime("%Y-%m-%d %H:%M:%S"),
            one_line(entry.first("Operation")) or "by hand",
            requesters or entry.author,
            entry.summary,
        )
    return table
