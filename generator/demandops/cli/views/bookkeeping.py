"""``demandops bookkeeping``: who requests what, now or at an earlier commit."""

from __future__ import annotations

import click
from rich.table import Table

from demandops.cli.json_output import output_option, show
from demandops.cli.output import at_option, progress, state_repo_option, warn_of
from demandops.plan.views.bookkeeping import Bookkeeping, as_data
from demandops.plan.views.bookkeeping import bookkeeping as derive
from demandops.staterepo import reader

_NONE = "(nothing)"


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
    tables = [_services(books), _connections(books)]
    if books.suspended:
        tables.append(_suspended(books))
    show(output, as_data(books, commit), [*tables, f"at {commit}"])


def _services(books: Bookkeeping) -> Table:
    table = Table("Service", "Kind", "Node", "For", "Takes in", "Requesters", title="Services")
    for name, entry in books.services.items():
        inputs = [topic for topics in entry.inputs.values() for topic in topics]
        table.add_row(
            name,
            entry.service,
            entry.node,
            entry.source or ", ".join(entry.applications),
            "\n".join(inputs),
            "\n".join(entry.requesters),
        )
    if not books.services:
        table.add_row(_NONE, *[""] * 5)
    return table


def _connections(books: Bookkeeping) -> Table:
    table = Table("Connection", "From", "To", "Topics", "Requesters", title="Connections")
    for id, entry in books.connections.items():
        table.add_row(
            id, entry.source, entry.target, "\n".join(entry.topics), "\n".join(entry.requesters)
        )
    if not books.connections:
        table.add_row(_NONE, *[""] * 4)
    return table


def _suspended(books: Bookkeeping) -> Table:
    table = Table("Subject", "Demand", "Requesters", "By", "Reason", title="Suspended")
    for entry in books.suspended:
        subject = f"{entry.kind} {entry.id}"
        requesters = "\n".join(entry.requesters)
        table.add_row(subject, entry.demand, requesters, entry.override, entry.reason)
    return table
