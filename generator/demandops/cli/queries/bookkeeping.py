"""``demandops bookkeeping``: who requests what, now or at an earlier commit."""

from __future__ import annotations

from collections.abc import Mapping

import click

from demandops.cli.json_output import Json, output_option, show, time_text
from demandops.cli.output import at_option, progress, version_lines, warn_of_problems
from demandops.cli.table import Table, column, joined, table_of
from demandops.cli.target import state_repo_option
from demandops.repo import reader
from demandops.views.bookkeeping import as_data, carried_topics
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
        warn_of_problems(repo, snapshot)
    commit = str(snapshot.commit)
    data = as_data(derive(snapshot.state), commit)
    capacity = [
        {"node": node, "name": name, **amounts}
        for node, resources in data.get("nodes", {}).items()
        for name, amounts in resources.items()
    ]
    text: list[str | Table] = []
    for title, columns, items in (
        ("Services", _SERVICES, _named(data["services"])),
        ("Connections", _CONNECTIONS, _named(data["connections"])),
        ("Suspended", _SUSPENDED, data.get("suspended")),
        ("Capacity", _CAPACITY, capacity),
        ("Waiting for room", _WAITING, data.get("waiting")),
    ):
        if items or title in ("Services", "Connections"):
            text += [table_of(columns, items or (), title=title), ""]
    show(output, data, [*text, f"at {commit}"])


def _named(entries: dict[str, Json]) -> list[Json]:
    return [{"name": name, **entry} for name, entry in entries.items()]


def _topics(topics: Mapping[str, list[str]], entry: Json) -> list[str]:
    # a topic is followed by its requesters if the entry has others too
    return [
        topic if who == entry["requesters"] else f"{topic} ({', '.join(who)})"
        for topic, who in topics.items()
    ]


_SERVICES = (
    column("Service", "name"),
    column(
        "Kind",
        lambda entry: [
            entry["service"],
            *(f"{name} = {value}" for name, value in entry["parameters"].items()),
        ],
        5,
    ),
    column("Version", version_lines, 4),
    column("Node", "node", 1),
    column("For", lambda entry: entry["source"] or entry["applications"], 3, wraps=True),
    column(
        "Takes in",
        lambda entry: [
            line for topics in entry["inputs"].values() for line in _topics(topics, entry)
        ],
        6,
    ),
    column("Requesters", joined("requesters"), 2, wraps=True),
)
_CONNECTIONS = (
    column("Connection", "name"),
    column("By", "type", 3),
    column("From", "source", 1),
    column("To", "target", 1),
    column("Topics", lambda entry: _topics(carried_topics(entry), entry), 4),
    column("Requesters", joined("requesters"), 2, wraps=True),
)
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
