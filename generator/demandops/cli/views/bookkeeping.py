"""``demandops bookkeeping``: who requests what, now or at an earlier commit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict

import click

from demandops.cli.json_output import output_option, show, time_text
from demandops.cli.output import at_option, progress, version_lines, warn_of
from demandops.cli.table import Column, Table
from demandops.cli.target import state_repo_option
from demandops.repo import reader
from demandops.views.bookkeeping import ConnectionEntry, ServiceEntry, as_data
from demandops.views.bookkeeping import bookkeeping as derive


@click.command()
@state_repo_option
@at_option
@output_option
def bookkeeping(state_repo: str, at: str | None, output: str) -> None:
    """Show who requests which service and connection.

    \b
    Examples:
      demandops bookkeeping
      demandops bookkeeping --at 14:03 -o json
    """
    with reader.opened(state_repo) as repo:
        with progress("reading the ledger") as report:
            snapshot = repo.snapshot(at, report)
        warn_of(repo.problems() if at is None else ())
    books, commit = derive(snapshot.state), str(snapshot.commit)
    services = [
        (
            name,
            [entry.service, *(f"{key} = {value}" for key, value in entry.parameters.items())],
            version_lines(asdict(entry)),
            entry.node,
            entry.source or entry.applications,
            [line for topics in entry.inputs.values() for line in _lines(topics, entry)],
            ", ".join(entry.requesters),
        )
        for name, entry in books.services.items()
    ]
    connections = [
        (
            id,
            entry.type,
            entry.source,
            entry.target,
            list(_lines(entry.topics, entry)),
            ", ".join(entry.requesters),
        )
        for id, entry in books.connections.items()
    ]
    suspended = [
        (
            f"{claim.kind} {claim.id}",
            claim.demand,
            ", ".join(claim.requesters),
            claim.override,
            claim.reason,
        )
        for claim in books.suspended
    ]
    text: list[str | Table] = [
        Table(_SERVICES, services, "Services"),
        "",
        Table(_CONNECTIONS, connections, "Connections"),
        "",
    ]
    if suspended:
        text += [Table(_SUSPENDED, suspended, "Suspended"), ""]
    if books.nodes:
        capacity = [
            (node, name, each.requested, each.capacity)
            for node, resources in books.nodes.items()
            for name, each in resources.items()
        ]
        text += [Table(_CAPACITY, capacity, "Capacity"), ""]
    if books.waiting:
        waiting = [
            (
                demand.demand,
                "\n".join(demand.requesters),
                time_text(demand.since),
                str(demand.priority),
            )
            for demand in books.waiting
        ]
        text += [Table(_WAITING, waiting, "Waiting for room"), ""]
    show(output, as_data(books, commit), [*text, f"at {commit}"])


_SERVICES = (
    Column("Service"),
    Column("Kind", 5),
    Column("Version", 4),
    Column("Node", 1),
    Column("For", 3, wraps=True),
    Column("Takes in", 6),
    Column("Requesters", 2, wraps=True),
)
_CONNECTIONS = (
    Column("Connection"),
    Column("By", 3),
    Column("From", 1),
    Column("To", 1),
    Column("Topics", 4),
    Column("Requesters", 2, wraps=True),
)
_SUSPENDED = (
    Column("Subject"),
    Column("Demand", 3),
    Column("Requesters", 2, wraps=True),
    Column("By", 1),
    Column("Reason", 4, wraps=True),
)
_WAITING = (
    Column("Demand"),
    Column("Requesters", 2, wraps=True),
    Column("Since", 1),
    Column("Priority", 1),
)
_CAPACITY = (Column("Node"), Column("Resource"), Column("Requested"), Column("Capacity"))


def _lines(topics: Mapping[str, list[str]], entry: ServiceEntry | ConnectionEntry) -> Iterator[str]:
    # a topic is followed by its requesters if the entry has others too
    for topic, who in topics.items():
        yield topic if who == entry.requesters else f"{topic} ({', '.join(who)})"
