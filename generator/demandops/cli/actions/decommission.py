"""``demandops decommission``: release all that a node or a requester holds, in one commit."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import click

from demandops.cli.actions.request import show_releases
from demandops.cli.output import (
    console,
    output_option,
    print_json,
    progress,
    signing_option,
    state_repo_option,
)
from demandops.decision import decide
from demandops.demand import decommission_goal
from demandops.errors import Refused
from demandops.ledger.apply import ClaimChange
from demandops.service import Generator
from demandops.staterepo import reader
from demandops.staterepo.history import authorship
from demandops.staterepo.load.snapshot import Snapshot


@click.command()
@click.argument("name", metavar="NODE|REQUESTER")
@state_repo_option
@click.option("--node", "kinds", flag_value="node", help="As a node only.")
@click.option("--requester", "kinds", flag_value="requester", help="As a requester only.")
@click.option("--dry-run", is_flag=True, help="Show the consequence and release nothing.")
@signing_option
@output_option
def decommission(
    name: str,
    state_repo: str,
    kinds: str | None,
    dry_run: bool,
    signing_key: Path | None,
    output: str,
) -> None:
    """Release all that a node or a requester holds, for it leaves for good.

    Of a node: the applications at it, the inputs from it and the connections that end at it, in
    whosever name; afterwards it can be deleted from the inventory. Of a requester: its claims; one
    that stands in other names too keeps standing in those. Where a name is both, both.
    """
    goal = decommission_goal.as_data(
        name, (kinds,) if kinds else ("node", "requester"), authorship.operator()
    )
    try:
        if dry_run:
            row = _rehearsed(goal, state_repo, output)
        else:
            row = _done(goal, state_repo, signing_key)
    except _NothingHeld:
        row = _row(name, "unchanged", None, ())
    if output == "json":
        print_json(row)
    else:
        _print(row, dry_run)


class _NothingHeld(Exception):
    """A node that is known and holds nothing: there is nothing to do, and nothing wrong."""


def _held_by_nobody(error: Refused, name: str, snapshot: Snapshot) -> bool:
    codes = {found.code for found in error.faults}
    return codes == {"not-held"} and name in snapshot.state.config.nodes


def _done(goal: dict[str, Any], state_repo: str, signing_key: Path | None) -> dict[str, Any]:
    with progress("reading the ledger") as tell:
        generator = Generator(
            state_repo, start_offline=False, signing_key=signing_key, progress=tell
        )
    try:
        receipt = generator.submit(goal).future.result()
        return _row(goal["name"], receipt.outcome, receipt.commit, receipt.changes)
    except Refused as error:
        if _held_by_nobody(error, goal["name"], generator.snapshot):
            raise _NothingHeld from None
        raise
    finally:
        generator.close(timeout=0)


def _rehearsed(goal: dict[str, Any], state_repo: str, output: str) -> dict[str, Any]:
    with reader.opened(state_repo) as repo, progress("reading the ledger") as tell:
        snapshot = repo.snapshot(progress=tell)
        try:
            decision = decide(snapshot.state, goal, datetime.now(timezone.utc), repo.file_reader())
        except Refused as error:
            if _held_by_nobody(error, goal["name"], snapshot):
                raise _NothingHeld from None
            raise
    if output == "text":
        show_releases(decision)
    return _row(goal["name"], decision.outcome, None, decision.changes.claims)


def _row(
    name: str, outcome: str, commit: str | None, changes: Iterable[ClaimChange]
) -> dict[str, Any]:
    return {
        "name": name,
        "outcome": outcome,
        "commit": commit,
        "claims": [
            {
                "kind": change.key.subject.kind.value[:-1],
                "id": change.key.subject.id,
                "demand": change.key.demand,
                "requesters": list(change.before.requesters) if change.before else [],
                "left": list(change.after.requesters) if change.after else None,
            }
            for change in changes
        ],
    }


def _print(row: dict[str, Any], dry_run: bool) -> None:
    out = console()
    if row["outcome"] == "unchanged":
        out.print(f"'{row['name']}' holds nothing")
        return
    would = "would be " if dry_run else ""
    for claim in row["claims"]:
        text = f"{claim['kind']} '{claim['id']}' for {', '.join(claim['requesters'])}"
        if claim["left"] is None:
            out.print(f"{would}released: {text}")
        else:
            out.print(f"{would}reduced:  {text}; kept for {', '.join(claim['left'])}")
    if not dry_run:
        out.print(f"'{row['name']}' is decommissioned in {row['commit']}")
