"""``demandops bookkeeping``: who requests what, now or at an earlier commit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict

import click
from rich.table import Table

from demandops.cli.json_output import output_option, show
from demandops.cli.output import at_option, progress, state_repo_option, version_text, warn_of
from demandops.plan.views.bookkeeping import ConnectionEntry, ServiceEntry, as_data
from demandops.plan.views.bookkeeping import bookkeeping as derive
from demandops.staterepo import reader


@click.command()
@state_repo_option
@at_option
@output_option
def bookkeeping(state_repo: str, at: str | None, output: str) -> None:
    """Show who requests which service and connection."""
    with reader.opened(state_repo) as repo:
        with progress("reading the ledger") as report:
            snapshot = repo.snapshot(at, report)
        warn_of(repo.problems() if at is None else ())
    books, commit = derive(snapshot.state), str(snapshot.commit)
    services = [
        (
            name,
            "\n".join([entry.service, *(f"{key} = {v}" for key, v in entry.parameters.items())]),
            version_text(asdict(entry)),
            entry.node,
            entry.source or ", ".join(entry.applications),
            "\n".join(line for topics in entry.inputs.values() for line in _lines(topics, entry)),
            "\n".join(entry.requesters),
        )
        for name, entry in books.services.items()
    ]
    connections = [
        (
            id,
            entry.type,
            entry.source,
            entry.target,
            "\n".join(_lines(entry.topics, entry)),
            "\n".join(entry.requesters),
        )
        for id, entry in books.connections.items()
    ]
    suspended = [
        (
            f"{entry.kind} {entry.id}",
            entry.demand,
            "\n".join(entry.requesters),
            entry.override,
            entry.reason,
        )
        for entry in books.suspended
    ]
    kinds = ("Service", "Kind", "Version", "Node", "For", "Takes in", "Requesters")
    tables = [
        _table("Services", kinds, services),
        _table(
            "Connections", ("Connection", "By", "From", "To", "Topics", "Requesters"), connections
        ),
    ]
    if suspended:
        columns = ("Subject", "Demand", "Requesters", "By", "Reason")
        tables.append(_table("Suspended", columns, suspended))
    show(output, as_data(books, commit), [*tables, f"at {commit}"])


def _lines(topics: Mapping[str, list[str]], entry: ServiceEntry | ConnectionEntry) -> Iterator[str]:
    """Yield each topic, with its requesters if they are not all of the entry's."""
    for topic, who in topics.items():
        yield topic if who == entry.requesters else f"{topic} ({', '.join(who)})"


def _table(title: str, columns: Iterable[str], rows: Iterable[tuple[str, ...]]) -> Table:
    table = Table(*columns, title=title)
    for row in rows or [("(nothing)",)]:
        table.add_row(*row)
    return table
