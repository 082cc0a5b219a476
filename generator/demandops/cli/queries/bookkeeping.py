"""``demandops bookkeeping``: who requests what, now or at an earlier commit."""

from __future__ import annotations

from dataclasses import replace

import click

from demandops.cli.json_output import output_formats, show
from demandops.cli.output import at_option
from demandops.cli.queries.diff import loaded
from demandops.cli.table import Table, column, list_table, table_of
from demandops.cli.target import state_repo_option
from demandops.decide.bookkeeping import as_data
from demandops.decide.bookkeeping import bookkeeping as derive
from demandops.repo import reader
from demandops.views.kinds import KINDS, rows_of
from demandops.views.source import Source
from demandops.views.vocabulary import time_text


@click.command()
@state_repo_option
@at_option
@output_formats("text", "wide", "json")
def bookkeeping(state_repo: str, at: str | None, output: str) -> None:
    """Show who requests which service and connection.

    \b
    Examples:
      demandops bookkeeping
      demandops bookkeeping --at 14:03 -o json
    """
    with reader.opened(state_repo) as repo:
        source = Source.read(repo, loaded(repo, at))
    data = as_data(derive(source.state), source.commit)
    capacity = [
        {"node": node, "name": name, **amounts}
        for node, resources in data.get("nodes", {}).items()
        for name, amounts in resources.items()
    ]
    text: list[str | Table] = []
    for name in ("services", "connections"):
        table = list_table(KINDS[name], rows_of(source, name), source.now, wide=True)
        text += [replace(table, title=name.title(), empty="(nothing)", whole=output == "wide"), ""]
    for title, columns, items in (
        ("Suspended", _SUSPENDED, data.get("suspended")),
        ("Capacity", _CAPACITY, capacity),
        ("Waiting for room", _WAITING, data.get("waiting")),
    ):
        if items:
            text += [table_of(columns, items, title=title), ""]
    show(output, data, [*text, f"at {source.commit}"])


_SUSPENDED = (
    column("Subject", lambda claim: "{kind} {id}".format(**claim)),
    column("Demand", "demand", 2),
    column("Requesters", "requesters", 1),
    column("By", "override", 3),
    column("Reason", "reason", 4),
)
_CAPACITY = (
    column("Node", "node"),
    column("Resource", "name"),
    column("Requested", "requested"),
    column("Capacity", "capacity"),
)
_WAITING = (
    column("Demand", "demand"),
    column("Requesters", "requesters", 2),
    column("Since", lambda demand: time_text(demand["since"]), 1),
    column("Priority", lambda demand: str(demand["priority"]), 1),
)
