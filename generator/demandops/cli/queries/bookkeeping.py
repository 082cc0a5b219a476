"""``demandops bookkeeping``: who requests what, now or at an earlier commit."""

from __future__ import annotations

import click

from demandops.cli.json_output import output_option, show, time_text
from demandops.cli.output import at_option
from demandops.cli.queries.diff import loaded
from demandops.cli.queries.get import KINDS
from demandops.cli.table import Table, column, joined, table_of
from demandops.cli.target import state_repo_option
from demandops.decide.bookkeeping import as_data
from demandops.decide.bookkeeping import bookkeeping as derive
from demandops.repo import reader


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
        snapshot = loaded(repo, at)
    commit = str(snapshot.commit)
    data = as_data(derive(snapshot.state), commit)
    capacity = [
        {"node": node, "name": name, **amounts}
        for node, resources in data.get("nodes", {}).items()
        for name, amounts in resources.items()
    ]
    text: list[str | Table] = []
    for name in ("services", "connections"):
        columns = (*KINDS[name].columns, *KINDS[name].wide)
        entries = [{"name": id, **entry} for id, entry in data[name].items()]
        text += [table_of(columns, entries, None, title=name.title()), ""]
    for title, columns, items in (
        ("Suspended", _SUSPENDED, data.get("suspended")),
        ("Capacity", _CAPACITY, capacity),
        ("Waiting for room", _WAITING, data.get("waiting")),
    ):
        if items:
            text += [table_of(columns, items, title=title), ""]
    show(output, data, [*text, f"at {commit}"])


_SUSPENDED = (
    column("Subject", lambda claim: "{kind} {id}".format(**claim)),
    column("Demand", "demand", 3),
    column("Requesters", joined("requesters"), 2, wraps=True),
    column("By", "override", 1),
    column("Reason", "reason", 4, wraps=True),
)
_CAPACITY = (
    column("Node", "node"),
    column("Resource", "name"),
    column("Requested", "requested"),
    column("Capacity", "capacity"),
)
_WAITING = (
    column("Demand", "demand"),
    column("Requesters", lambda demand: "\n".join(demand["requesters"]), 2, wraps=True),
    column("Since", lambda demand: time_text(demand["since"]), 1),
    column("Priority", lambda demand: str(demand["priority"]), 1),
)
