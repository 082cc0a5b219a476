"""``demandops overrides``: what people have overridden, and what each override does now."""

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
from demandops.plan.views.override_report import Entry, survey
from demandops.staterepo import reader


@click.command()
@state_repo_option
@click.option("--at", "at", metavar="REV|TIME", help=f"{REV_HELP}; the newest by default.")
@output_option
def overrides(state_repo: str, at: str | None, output: str) -> None:
    """List the overrides: what each does, for which releases and claims, whose it is, how long.

    One is in force, expired, or matches nothing at present. The releases are those that it shapes,
    or keeps from running; the claims those that it suspends, or would keep.
    """
    with reader.opened(state_repo) as repo, progress("reading the ledger") as tell:
        snapshot = repo.snapshot(at, tell)
    state = snapshot.state
    found = survey(state.ledger, state.config, datetime.now(timezone.utc))
    if output == "json":
        print_json([_row(entry) for entry in found])
        return
    out = console()
    if not found:
        out.print("no overrides; docs/overrides.md says how to write one")
        return
    table = Table("Override", "State", "Does", "To", "Priority", "Owner", "Until", "Reason")
    for entry in found:
        one = entry.override
        table.add_row(
            one.name,
            entry.state,
            "\n".join(_effects(entry)),
            "\n".join([*entry.releases, *entry.claims]),
            str(one.priority),
            one.owner,
            format_time(one.end) if one.end else "",
            one.reason,
        )
    out.print(table)
    out.print(f"at {snapshot.commit}")


def _effects(entry: Entry) -> list[str]:
    one = entry.override
    told = {
        "version": one.version,
        "replicas": one.replicas,
        "node": one.node,
        "images": ", ".join(one.images or ()),
        "values": ", ".join(one.values or ()),
    }
    return [f"{name} {told[name]}" if name in told else name for name in one.effects()]


def _row(entry: Entry) -> dict[str, Any]:
    one = entry.override
    return {
        "name": one.name,
        "file": one.path,
        "state": entry.state,
        "effects": {name: _plain(getattr(one, name)) for name in one.effects()},
        "releases": list(entry.releases),
        "claims": list(entry.claims),
        "priority": one.priority,
        "owner": one.owner,
        "until": format_time(one.end) if one.end else None,
        "reason": one.reason,
    }


def _plain(value: Any) -> Any:  # noqa: ANN401
    """Return an effect as it stands in the file; a null of a patch is a part of it."""
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return value.model_dump(exclude_none=True) if isinstance(value, ImagePin) else value
