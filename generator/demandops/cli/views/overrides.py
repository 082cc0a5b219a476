"""``demandops overrides``: the overrides, and what each one does now."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Any

import click
from rich.table import Table

from demandops.cli.output import (
    REV_HELP,
    console,
    output_option,
    print_json,
    progress,
    state_repo_option,
)
from demandops.config.override import ImagePin, format_time
from demandops.plan.views.override_report import Entry, override_report
from demandops.staterepo import reader


@click.command()
@state_repo_option
@click.option("--at", "at", metavar="REV|TIME", help=f"{REV_HELP}; default: the newest commit.")
@output_option
def overrides(state_repo: str, at: str | None, output: str) -> None:
    """List the overrides and what each one does.

    The state of an override is `in force`, `expired` or `matches nothing`. The list has the
    releases that it changes or denies, and the claims that it suspends or keeps.
    """
    with reader.opened(state_repo) as repo, progress("reading the ledger") as report:
        snapshot = repo.snapshot(at, report)
    state = snapshot.state
    entries = override_report(state, datetime.now(timezone.utc))
    if output == "json":
        print_json([_row(entry) for entry in entries])
        return
    out = console()
    if not entries:
        out.print("no overrides; see docs/overrides.md")
        return
    table = Table("Override", "State", "Does", "To", "Priority", "Owner", "Until", "Reason")
    for entry in entries:
        override = entry.override
        table.add_row(
            override.name,
            entry.state,
            "\n".join(_effects(entry)),
            "\n".join([*entry.releases, *entry.claims]),
            str(override.priority),
            override.owner,
            format_time(override.end) if override.end else "",
            override.reason,
        )
    out.print(table)
    out.print(f"at {snapshot.commit}")


def _effects(entry: Entry) -> list[str]:
    override = entry.override
    values = {
        "version": override.version,
        "replicas": override.replicas,
        "node": override.node,
        "images": ", ".join(override.images or ()),
        "values": ", ".join(override.values or ()),
    }
    return [f"{name} {values[name]}" if name in values else name for name in override.effects()]


def _row(entry: Entry) -> dict[str, Any]:
    override = entry.override
    return {
        "name": override.name,
        "file": override.path,
        "state": entry.state,
        "effects": {name: _plain(getattr(override, name)) for name in override.effects()},
        "releases": list(entry.releases),
        "claims": list(entry.claims),
        "priority": override.priority,
        "owner": override.owner,
        "until": format_time(override.end) if override.end else None,
        "reason": override.reason,
    }


def _plain(value: Any) -> Any:  # noqa: ANN401
    """Return an effect as written in the file. A patch keeps its null values."""
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return value.model_dump(exclude_none=True) if isinstance(value, ImagePin) else value
