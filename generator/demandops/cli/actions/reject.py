"""``demandops reject``: refuse a proposal."""

from __future__ import annotations

import click

from demandops.cli.actions.approve import commit_option, print_proposal, proposal_named
from demandops.cli.actions.person_change import confirm, writable, yes_option
from demandops.cli.json_output import output_option, show
from demandops.cli.name_completion import names_of
from demandops.cli.target import writable_repo_option
from demandops.staterepo.write.proposal_branch import ProposalBranches


@click.command()
@click.argument("name", metavar="BRANCH|DEMAND", shell_complete=names_of("proposals"))
@commit_option
@yes_option
@writable_repo_option
@output_option
def reject(name: str, commit: str, yes: bool, state_repo: str, output: str) -> None:
    """Turn a proposed demand down: delete its branch.

    The generator then aborts the goal with `turned-down`. If the branch has changed since the
    command read it, the command deletes nothing.

    \b
    Examples:
      demandops reject demand/visit-3f2a9c1b04de
      demandops reject visit --yes
    """
    with writable(state_repo, None) as repo:
        proposal = proposal_named(repo, name)
        if commit:
            proposal.require(commit)
        print_proposal(proposal, output)
        confirm("Turn it down?", yes, output)
        ProposalBranches(repo.repository).remove(proposal.branch, proposal.commit)
    data = {"outcome": "rejected", "branch": proposal.branch, "commit": proposal.commit}
    show(output, data, [f"turned down: {proposal.branch} is deleted"])
