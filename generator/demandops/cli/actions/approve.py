"""``demandops approve``: merge a proposal in the caller's own name."""

from __future__ import annotations

from pathlib import Path

import click

from demandops.cli.actions.person_change import (
    confirm,
    is_asked,
    reason_option,
    warned_if_unnamed,
    writable,
    yes_option,
)
from demandops.cli.json_output import output_option, show
from demandops.cli.name_completion import names_of
from demandops.cli.output import errors
from demandops.cli.target import signing_option, writable_repo_option
from demandops.cli.views.diff import differences, entry_lines, release_lines
from demandops.errors import InvalidInput, suggestion
from demandops.quoting import one_line
from demandops.runtime import REAL
from demandops.staterepo.reader import Reader
from demandops.staterepo.write import person_commit
from demandops.staterepo.write.person_commit import CommitDetails
from demandops.staterepo.write.proposal_branch import PendingProposal, pending_proposals

commit_option = click.option(
    "--commit",
    metavar="ID",
    default="",
    help="The whole id of the commit that you looked at. If the branch is at another commit, "
    "nothing is changed.",
)


def proposal_named(repo: Reader, name: str) -> PendingProposal:
    """Return the proposal that ``name`` identifies.

    ``name`` is the branch of the proposal, or the id of one of its demands. If no proposal has
    this branch or demand, ``name`` may be a part of a branch's name.

    Raises:
        InvalidInput: if no proposal or several proposals fit.
        RemoteAway: if the state repo cannot be reached.
    """
    pending = list(pending_proposals(repo.repository))
    # requesters choose ids of demands, so such an id may be the branch of another proposal
    found = (
        [one for one in pending if name == one.branch]
        or [one for one in pending if name in one.demands]
        or [one for one in pending if name in one.branch]
    )
    if len(found) == 1:
        return found[0]
    known = [one.branch for one in pending]
    if found:
        message = f"several proposals fit '{name}': {', '.join(one.branch for one in found)}"
    else:
        message = f"no proposal fits '{name}'{suggestion(name, known) or '; nothing is proposed'}"
    raise InvalidInput.at("", message)


def print_proposal(proposal: PendingProposal, output: str) -> None:
    """Print which proposal it is on stderr, unless output is JSON."""
    if output == "text":
        for line in (
            f"{proposal.branch} at commit {proposal.commit}",
            f"  {proposal.summary}",
            f"  for {', '.join(proposal.requesters)}, proposed {proposal.since:%F %H:%M} UTC",
            *(f"  required by {reason}" for reason in proposal.required_by),
            *(f"  changed: it replaces {old}" for old in proposal.replaces),
        ):
            errors.print(one_line(line))


def _print_consequence(repo: Reader, commit: str) -> None:
    base = repo.base_of(commit)
    entries, found = differences(repo, base, commit)
    by_hand = repo.edited_files(base, repo.last_valid_snapshot(commit))
    for line in (
        *entry_lines(entries),
        *release_lines(found.releases, "release "),
        *(f"~ file {path}" for path in by_hand),
    ):
        errors.print(f"  {one_line(line)}")


@click.command()
@click.argument("name", metavar="BRANCH|DEMAND", shell_complete=names_of("proposals"))
@reason_option
@commit_option
@yes_option
@writable_repo_option
@signing_option
@output_option
def approve(
    name: str,
    reason: str | None,
    commit: str,
    yes: bool,
    state_repo: str,
    signing_key: Path | None,
    output: str,
) -> None:
    """Approve a proposed demand: merge its branch in your own name.

    At a terminal, the command first shows what the merge would change, and asks. Elsewhere, and
    with --yes, name the commit that you looked at: --commit ID. If the branch is at another commit,
    the command merges nothing. The generator then answers the demand and removes the branch. If
    main has changed the same files since the proposal was made, the command merges nothing either.
    In this case, wait until a running generator has rebuilt the branch, and then approve the
    proposal again.

    \b
    Examples:
      demandops approve visit -m "Agreed with the control room"
      demandops approve visit --commit 5d41402abc4b2a76b9719d911017c592e81f9d3a
    """
    if not (commit or is_asked(yes, output)):
        raise click.UsageError(
            "name the commit that you looked at: --commit ID; `demandops get proposals` lists it"
        )
    with writable(state_repo, signing_key) as repo:
        proposal = proposal_named(repo, name)
        if commit:
            proposal.require(commit)
        print_proposal(proposal, output)
        if output == "text":
            _print_consequence(repo, proposal.commit)
        confirm("Approve it?", yes, output)
        summary = f"Approve {', '.join(proposal.demands) or proposal.branch}: {proposal.summary}"
        why = " ".join((reason or "").split())
        details = CommitDetails(warned_if_unnamed(repo.operator()), REAL.now(), summary, why)
        made = person_commit.merge(repo.repository, proposal, details)
    data = {"outcome": "approved", "branch": proposal.branch, "commit": made.commit}
    show(output, data, [f"approved: {proposal.branch} is merged in {made.commit}"])
