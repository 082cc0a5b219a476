"""``demandops overrides``: the overrides, and what each one does now."""

from __future__ import annotations

import click
from rich.table import Table

from demandops.cli.json_output import (
    claim_data,
    output_option,
    override_data,
    print_json,
    release_data,
)
from demandops.cli.output import at_option, console, progress, state_repo_option
from demandops.config.override import format_time
from demandops.plan.views.override_report import Entry, override_report
from demandops.runtime import REAL
from demandops.staterepo import reader


@click.command()
@state_repo_option
@at_option
@output_option
def overrides(state_repo: str, at: str | None, output: str) -> None:
    """List the overrides and what each one does.

    The state of an override is `in force`, `expired` or `matches nothing`. The list has the
    releases that it changes or denies, and the claims that it suspends or keeps.
    """
    with reader.opened(state_repo) as repo, progress("reading the ledger") as report:
        snapshot = repo.snapshot(at, report)
    state = snapshot.state
    entries = override_report(state, REAL.now())
    if output == "json":
        print_json(
            [
                {
                    **override_data(entry.override),
                    "state": entry.state,
                    "releases": [release_data(release) for release in entry.releases],
                    "claims": [claim_data(claim) for claim in entry.claims],
                }
                for entry in entries
            ]
        )
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
            "\n".join(_affected(entry)),
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


def _affected(entry: Entry) -> list[str]:
    claims = [f"{claim.subject} of {claim.demand}" for claim in entry.claims]
    return [*(release.name for release in entry.releases), *claims]
