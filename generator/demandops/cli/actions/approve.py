"""``demandops approve``: merge a proposal in the caller's own name."""

from __future__ import annotations

from pathlib import Path

import click

from demandops.cli.actions.person_change import (
    confirm,
    reason_option,
    warned_if_unnamed,
    writable,
    yes_option,
)
from demandops.cli.json_output import output_option, show
from demandops.cli.name_completion import names_of
from demandops.cli.output import errors
from demandops.cli.target import signing_option, writable_repo_option
from demandops.errors import InvalidInput, suggestion
from demandops.runtime import REAL
from demandops.staterepo.reader import Reader
from demandops.staterepo.write import person_commit
from demandops.staterepo.write.person_commit import CommitDetails
from demandops.staterepo.write.proposal_branch import PendingProposal, pending_proposals


def proposal_named(repo: Reader, name: str) -> PendingProposal:
    """Return the proposal that ``name`` identifies.

    ``name`` is the branch of the proposal, or the id of one of its demands. If no proposal has
    this branch or demand, ``name`` may be a part of a branch's name.

    Raises:
        InvalidInput: if no proposal or several proposals fit.
        RemoteAway: if the state repo cannot be reached.
    """
    pending = list(pending_proposals(repo.repository))
    exact = [one for one in pending if name == one.branch or name in one.demands]
    found = exact or [one for one in pending if name in one.branch]
    if len(found) == 1:
        return found[0]
    known = [one.branch for one in pending]
    if found:
        message = f"several proposals fit '{name}': {', '.join(one.branch for one in found)}"
    else:
        message = f"no proposal fits '{name}'{suggestion(name, known) or '; nothing is proposed'}"
    raise InvalidInput.at("", message)


def print_proposal(proposal: PendingProposal, output: str) -> None:
    """Print a proposal's branch, summary, requesters and time on stderr, unless output is JSON."""
    if output == "text":
        errors.print(f"{proposal.branch}: {proposal.summary}")
        errors.print(
            f"  for {', '.join(proposal.requesters)}, proposed {proposal.since:%F %H:%M} UTC"
        )


@click.command()
@click.argument("name", metavar="BRANCH|DEMAND", shell_complete=names_of("proposals"))
@reason_option
@yes_option
@writable_repo_option
@signing_option
@output_option
def approve(
    name: str,
    reason: str | None,
    yes: bool,
    state_repo: str,
    signing_key: Path | None,
    output: str,
) -> None:
    """Approve a proposed demand: merge its branch in your own name.

    The generator then answers the demand and removes the branch. If main has changed the same
    files since the proposal was made, the command merges nothing. In this case, wait until a
    running generator has rebuilt the branch, and then approve the proposal again.

    \b
    Examples:
      demandops approve demand/visit-3f2a9c1b04de
      demandops approve visit -m "Agreed with the control room"
    """
    with writable(state_repo, signing_key) as repo:
        proposal = proposal_named(repo, name)
        print_proposal(proposal, output)
        confirm("Approve it?", yes, output)
        summary = f"Approve {', '.join(proposal.demands) or proposal.branch}: {proposal.summary}"
        why = " ".join((reason or "").split())
        details = CommitDetails(warned_if_unnamed(repo.operator()), REAL.now(), summary, why)
        made = person_commit.merge(repo.repository, proposal, details)
    data = {"outcome": "approved", "branch": proposal.branch, "commit": made.commit}
    show(output, data, [f"approved: {proposal.branch} is merged in {made.commit}"])
