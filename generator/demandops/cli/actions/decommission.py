"""``demandops decommission``: release all claims of a node or a requester, in one commit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import click

from demandops.cli.actions.ledger_change import (
    booked,
    claim_text,
    print_consequences,
    started_generator,
)
from demandops.cli.actions.person_change import (
    confirm,
    is_asked,
    reason_option,
    warned_if_unnamed,
    yes_option,
)
from demandops.cli.json_output import Json, claim_data, output_option, show
from demandops.cli.name_completion import names_of
from demandops.cli.output import progress
from demandops.cli.target import dry_run_option, signing_option, writable_repo_option
from demandops.decision import decide
from demandops.demand.demand_request import Decommission
from demandops.errors import Refused
from demandops.ledger.claim_changes import ClaimChange
from demandops.runtime import REAL
from demandops.staterepo import reader
from demandops.staterepo.history import authorship
from demandops.staterepo.history.authorship import Person
from demandops.staterepo.load.snapshot import Snapshot


@click.command()
@click.argument("name", metavar="NODE|REQUESTER", shell_complete=names_of("nodes", "requesters"))
@writable_repo_option
@click.option(
    "--node",
    "kinds",
    flag_value="node",
    help="Decommission only the node NAME, not a requester of the same name.",
)
@click.option(
    "--requester",
    "kinds",
    flag_value="requester",
    help="Decommission only the requester NAME, not a node of the same name.",
)
@reason_option
@dry_run_option
@yes_option
@signing_option
@output_option
def decommission(  # noqa: PLR0913, PLR0917 - each is an option
    name: str,
    state_repo: str,
    kinds: str | None,
    reason: str | None,
    dry_run: bool,
    yes: bool,
    signing_key: Path | None,
    output: str,
) -> None:
    """Release all claims of a node or a requester.

    For a node, the command releases the applications on the node, the inputs that come from the
    node, the deliveries to the node, and the connections from and to the node, for every requester.
    Then you can delete the node from the inventory. For a requester, the command releases all
    claims of this requester, even claims that also name other requesters. It also ends the waiting
    demands that name only this requester. If NAME is both a node and a requester, the command does
    both. At a terminal, the command first shows the consequences and asks.

    \b
    Examples:
      demandops decommission vehicle00 --dry-run
      demandops decommission vehicle00 -m "Sold" --yes
      demandops decommission edge --node
    """
    chosen = frozenset([kinds] if kinds else ["node", "requester"])
    by = authorship.operator()
    goal = Decommission(
        name, kinds=chosen, by=str(by), reason=" ".join((reason or "").split())
    ).goal()
    if dry_run or is_asked(yes, output):
        row = _dry_run(goal, state_repo, output)
        show(output, row, _lines(row, True))
        if dry_run or row["outcome"] == "unchanged":
            return
        confirm("Continue?", yes, output)
    row = _book(goal, by, state_repo, signing_key)
    show(output, row, _lines(row, False))


def _book(goal: Json, by: Person, state_repo: str, signing_key: Path | None) -> Json:
    # through the journal, like a demand, so it may run beside other generators
    with started_generator(state_repo, signing_key) as generator:
        warned_if_unnamed(by)
        try:
            receipt = booked(generator, goal)
        except Refused as error:
            if not _is_unclaimed_node(error, goal, generator.snapshot):
                raise
            return _row(goal, "unchanged", None, ())
    return _row(goal, receipt.outcome, receipt.commit, receipt.changes)


def _dry_run(goal: Json, state_repo: str, output: str) -> Json:
    with reader.opened(state_repo) as repo, progress("reading the ledger") as report:
        snapshot = repo.snapshot(progress=report)
        try:
            decision = decide(snapshot.state, goal, REAL.now(), repo.file_reader())
        except Refused as error:
            if not _is_unclaimed_node(error, goal, snapshot):
                raise
            return _row(goal, "unchanged", None, ())
    if output == "text":
        print_consequences(decision)
    return _row(goal, decision.outcome, None, decision.changes.claims)


def _is_unclaimed_node(error: Refused, goal: Json, snapshot: Snapshot) -> bool:
    # a node that holds nothing is no error; any other name that holds nothing may be misspelled
    codes = {each.code for each in error.faults}
    return codes == {"not-held"} and goal["name"] in snapshot.state.config.nodes


def _row(goal: Json, outcome: str, commit: str | None, changes: Iterable[ClaimChange]) -> Json:
    claims = [
        claim_data(change.before)
        | {"left": list(change.after.requesters) if change.after else None}
        for change in changes
        if change.before
    ]
    return {"name": goal["name"], "outcome": outcome, "commit": commit, "claims": claims}


def _lines(row: Json, dry_run: bool) -> Iterator[str]:
    if row["outcome"] == "unchanged":
        yield f"'{row['name']}' holds nothing"
        return
    would = "would be " if dry_run else ""
    for claim in row["claims"]:
        text = f"{claim_text(claim)} for {', '.join(claim['requesters'])}"
        if claim["left"] is None:
            yield f"{would}released: {text}"
        else:
            yield f"{would}reduced:  {text}; kept for {', '.join(claim['left'])}"
    if not dry_run:
        yield f"'{row['name']}' is decommissioned in {row['commit']}"
