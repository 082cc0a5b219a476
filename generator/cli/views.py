"""``demandops bookkeeping``, ``log`` and ``diff``: what the state repo says, now and before."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from itertools import islice
from typing import Any

import click
from rich.table import Table

from generator.cli.output import (
    console,
    errors,
    output_option,
    print_json,
    progress,
    state_repo_option,
)
from generator.plan.bookkeeping import Bookkeeping, as_data
from generator.plan.bookkeeping import bookkeeping as derive
from generator.staterepo import reader
from generator.staterepo.history import LogEntry
from generator.staterepo.reader import Reader

_NONE = "(nothing)"


def _books(repo: Reader, revision: str | None) -> tuple[Bookkeeping, str]:
    with progress("reading the ledger") as tell:
        snapshot = repo.snapshot(revision, tell)
    for problem in repo.problems() if revision is None else ():
        errors.print(f"warning: {problem}; its last valid version is in force")
    return derive(snapshot.state.ledger, snapshot.state.catalog), str(snapshot.commit)


@click.command()
@state_repo_option
@click.option("--at", "at", metavar="REV", help="A commit, tag or branch; the newest by default.")
@output_option
def bookkeeping(state_repo: str, at: str | None, output: str) -> None:
    """Show who requests which service and connection."""
    with reader.opened(state_repo) as repo:
        books, commit = _books(repo, at)
    if output == "json":
        print_json(as_data(books, commit))
        return
    out = console()
    out.print(services_table(books))
    out.print(connections_table(books))
    if books.suspended:
        out.print(suspended_table(books))
    out.print(f"at {commit}")


def services_table(books: Bookkeeping) -> Table:
    """Return the services as a table."""
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


def connections_table(books: Bookkeeping) -> Table:
    """Return the connections as a table."""
    table = Table("Connection", "From", "To", "Topics", "Requesters", title="Connections")
    for id, entry in books.connections.items():
        table.add_row(
            id, entry.source, entry.target, "\n".join(entry.topics), "\n".join(entry.requesters)
        )
    if not books.connections:
        table.add_row(_NONE, *[""] * 4)
    return table


def suspended_table(books: Bookkeeping) -> Table:
    """Return the claims that overrides keep from running, as a table."""
    table = Table("Subject", "Demand", "Requesters", "By", "Reason", title="Suspended")
    for entry in books.suspended:
        subject = f"{entry.kind} {entry.id}"
        requesters = "\n".join(entry.requesters)
        table.add_row(subject, entry.demand, requesters, entry.override, entry.reason)
    return table


@click.command()
@click.argument("revisions", required=False, metavar="[REV|A..B]")
@state_repo_option
@click.option("-n", "--max-count", type=click.IntRange(1), default=None, help="At most so many.")
@output_option
def log(revisions: str | None, state_repo: str, max_count: int | None, output: str) -> None:
    """Show the commits of the state repo, newest first."""
    with reader.opened(state_repo) as repo:
        entries = list(islice(repo.log(revisions), max_count))
    if output == "json":
        print_json([_log_row(entry) for entry in entries])
        return
    table = Table("Commit", "Time (UTC)", "Operation", "Requesters", "What")
    for entry in entries:
        requesters = entry.trailers.get("Requester")
        table.add_row(
            entry.commit[:10],
            entry.time.strftime("%Y-%m-%d %H:%M:%S"),
            entry.one("Operation") or "by hand",
            ", ".join(requesters) if requesters else entry.author,
            entry.summary,
        )
    console().print(table)


def _log_row(entry: LogEntry) -> dict[str, Any]:
    return {
        "commit": entry.commit,
        "time": entry.time.isoformat(),
        "author": entry.author,
        "summary": entry.summary,
        "operation": entry.one("Operation") or None,
        "operation_id": entry.one("Operation-Id") or None,
        "request_id": entry.one("Request-Id") or None,
        "demand_ids": entry.trailers.get("Demand-Id", []),
        "requesters": entry.trailers.get("Requester", []),
        "applications": entry.trailers.get("Application", []),
        "connections": entry.trailers.get("Connection", []),
        "render_version": entry.one("Render-Version") or None,
    }


@click.command()
@click.argument("before", metavar="A")
@click.argument("after", metavar="B")
@state_repo_option
@output_option
def diff(before: str, after: str, state_repo: str, output: str) -> None:
    """Show what differs in bookkeeping between two commits."""
    with reader.opened(state_repo) as repo:
        (old, _), (new, _) = _books(repo, before), _books(repo, after)
    data = {
        "services": _changes(asdict(old)["services"], asdict(new)["services"]),
        "connections": _changes(asdict(old)["connections"], asdict(new)["connections"]),
    }
    if output == "json":
        print_json(data)
        return
    out = console()
    lines = list(_lines(data))
    for line in lines or ["no difference in bookkeeping"]:
        out.print(line)


def _changes(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    return {
        "added": {name: _plain(new[name]) for name in sorted(new.keys() - old.keys())},
        "removed": {name: _plain(old[name]) for name in sorted(old.keys() - new.keys())},
        "changed": {
            name: {"before": _plain(old[name]), "after": _plain(new[name])}
            for name in sorted(old.keys() & new.keys())
            if old[name] != new[name]
        },
    }


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _lines(data: dict[str, Any]) -> Iterator[str]:
    for kind in ("services", "connections"):
        word = kind[:-1]
        for name, entry in data[kind]["added"].items():
            yield f"+ {word} {name} for {', '.join(entry['requesters'])}"
        for name, sides in data[kind]["changed"].items():
            yield f"~ {word} {name}"
            before, after = set(_facts(sides["before"])), set(_facts(sides["after"]))
            yield from (f"    - {fact}" for fact in sorted(before - after))
            yield from (f"    + {fact}" for fact in sorted(after - before))
        for name, entry in data[kind]["removed"].items():
            yield f"- {word} {name} for {', '.join(entry['requesters'])}"


def _facts(entry: dict[str, Any]) -> Iterable[str]:
    for requester in entry["requesters"]:
        yield f"requester {requester}"
    for role, topics in entry.get("inputs", {}).items():
        yield from (f"{role} {topic}" for topic in topics)
    yield from (f"topic {topic}" for topic in entry.get("topics", ()))
    for key in ("node", "source", "target"):
        if key in entry:
            yield f"{key} {entry[key]}"
