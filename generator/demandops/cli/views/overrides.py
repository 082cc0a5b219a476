"""``demandops overrides``: the overrides, and what each one does now."""

from __future__ import annotations

import click
from rich.table import Table

from demandops.cli.json_output import (
    claim_data,
    output_option,
    override_data,
    release_data,
    show,
)
from demandops.cli.output import at_option, progress, state_repo_option
from demandops.config.override import Override, format_time
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
    entries = override_report(snapshot.state, REAL.now())
    data = [
        {
            **override_data(entry.override),
            "state": entry.state,
            "releases": [release_data(release) for release in entry.releases],
            "claims": [claim_data(claim) for claim in entry.claims],
        }
        for entry in entries
    ]
    text: list[str | Table] = [_table(entries), f"at {snapshot.commit}"]
    show(output, data, text if entries else ["no overrides; see docs/overrides.md"])


def _table(entries: list[Entry]) -> Table:
    table = Table("Override", "State", "Does", "To", "Priority", "Owner", "Until", "Reason")
    for entry in entries:
        override = entry.override
        claims = [f"{claim.subject} of {claim.demand}" for claim in entry.claims]
        table.add_row(
            override.name,
            entry.state,
            "\n".join(_effects(override)),
            "\n".join([*(release.name for release in entry.releases), *claims]),
            str(override.priority),
            override.owner,
            format_time(override.end) if override.end else "",
            override.reason,
        )
    return table


def _effects(override: Override) -> list[str]:
    values = {
        "version": override.version,
        "replicas": override.replicas,
        "node": override.node,
        "images": ", ".join(override.images or ()),
        "values": ", ".join(override.values or ()),
    }
    return [f"{name} {values[name]}" if name in values else name for name in override.effects()]
