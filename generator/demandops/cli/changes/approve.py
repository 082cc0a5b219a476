"""``demandops approve`` and ``demandops reject``: a person answers a proposal."""

from __future__ import annotations

import sys

import click

from demandops.base.errors import InvalidInput, suggestion
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL
from demandops.cli.changes.person_change import (
    Options,
    changing,
    confirm,
    warned_if_unnamed,
    writable,
)
from demandops.cli.json_output import show
from demandops.cli.output import done, errors
from demandops.cli.queries.diff import differences, entry_lines, release_lines
from demandops.cli.target import names_of
from demandops.repo.git.repository import PushDenied
from demandops.repo.reader import Reader
from demandops.repo.write import person_commit
from demandops.repo.write.person_commit import CommitDetails
from demandops.repo.write.proposal_branch import (
    OF_PEOPLE,
    BranchMoved,
    PendingProposal,
    ProposalBranches,
    pending_proposals,
)

# ---- ``demandops approve``: merge a proposal in the caller's own name ----

_named = click.argument("name", metavar="BRANCH|DEMAND", shell_complete=names_of("proposals"))
_answering = changing(
    click.option(
        "--commit",
        metavar="ID",
        default="",
        help="The whole id of the commit that you looked at. If the branch is at another commit, "
        "nothing is changed.",
    ),
    dry_run=False,
)


def _proposal(repo: Reader, name: str, commit: str, output: str) -> PendingProposal:
    pending = list(pending_proposals(repo.repository))
    # requesters choose ids of demands, so such an id may be the branch of another proposal
    fitting = (
        [proposal for proposal in pending if name == proposal.branch]
        or [proposal for proposal in pending if name in proposal.demands]
        or [proposal for proposal in pending if name in proposal.branch]
    )
    if len(fitting) != 1:
        close = suggestion(name, [proposal.branch for proposal in pending])
        message = f"no proposal fits '{name}'{close or '; nothing is proposed'}"
        if fitting:
            branches = ", ".join(proposal.branch for proposal in fitting)
            message = f"several proposals fit '{name}': {branches}"
        raise InvalidInput.at("", message)
    (proposal,) = fitting
    if commit:
        proposal.require(commit)
    if output == "text":
        who = f"for {', '.join(proposal.requesters)}" if proposal.requesters else proposal.author
        for line in (
            f"{proposal.branch} at commit {proposal.commit}",
            f"  {proposal.summary}",
            f"  {who}, proposed {proposal.since:%F %H:%M} UTC",
            *(f"  required by {reason}" for reason in proposal.required_by),
            *(f"  changed: it replaces {old}" for old in proposal.replaces),
        ):
            errors.print(one_line(line))
    return proposal


@click.command()
@_named
@_answering
def approve(name: str, commit: str, options: Options) -> None:
    """Approve a proposal: merge its branch in your own name.

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
    if not commit and (options.yes or not sys.stdin.isatty()):
        raise click.UsageError(
            "name the commit that you looked at: --commit ID; `demandops get proposals` lists it"
        )
    with writable(options) as repo:
        proposal = _proposal(repo, name, commit, options.output)
        if options.output == "text":
            base = repo.base_of(proposal.commit)
            entries, preview = differences(repo, base, proposal.commit)
            # anybody can commit under the generator's name, so what is more than demands is shown
            by_hand = repo.edited_files(base, repo.snapshot(proposal.commit))
            for line in (
                *entry_lines(entries),
                *release_lines(preview.releases, "release "),
                *(f"~ file {path}" for path in by_hand),
            ):
                errors.print(f"  {one_line(line)}")
        confirm("Approve it?", options.yes or bool(commit))
        summary = f"Approve {', '.join(proposal.demands) or proposal.branch}: {proposal.summary}"
        person = warned_if_unnamed(repo.operator())
        details = CommitDetails(person, REAL.now(), summary, options.reason)
        merged = person_commit.merge(repo.repository, proposal, details)
        done.append(f"{proposal.branch} is merged in {merged.commit}")
        if proposal.branch.startswith(OF_PEOPLE):  # a generator removes only its own branches
            _remove(repo, proposal)
    data = {"outcome": "approved", "branch": proposal.branch, "commit": merged.commit}
    show(options.output, data, [f"approved: {proposal.branch} is merged in {merged.commit}"])


# ---- ``demandops reject``: refuse a proposal ----


@click.command()
@_named
@_answering
def reject(name: str, commit: str, options: Options) -> None:
    """Reject a proposal: delete its branch, and record who and why.

    The requester gets the reason; the generator aborts the goal with `turned-down`. If the branch
    has changed since the command read it, the command changes nothing.

    \b
    Examples:
      demandops reject visit -m "The road is closed"
      demandops reject demand/visit-3f2a9c1b04de --yes
    """
    with writable(options) as repo:
        proposal = _proposal(repo, name, commit, options.output)
        confirm("Reject it?", options.yes or bool(commit))
        summary = f"Reject {', '.join(proposal.demands) or proposal.branch}: {proposal.summary}"
        person = warned_if_unnamed(repo.operator())
        details = CommitDetails(person, REAL.now(), summary, options.reason)
        recorded = None
        try:
            recorded = person_commit.reject(repo.repository, proposal, details).commit
            done.append(f"commit {recorded} rejects {proposal.branch}")
        except PushDenied as denied:  # who may not write to main may still close a proposal
            errors.print(f"warning: your name and reason are not recorded: {denied}")
        _remove(repo, proposal)
    data = {"outcome": "rejected", "branch": proposal.branch, "commit": recorded}
    where = f"recorded in {recorded}, " if recorded else ""
    show(options.output, data, [f"rejected: {where}{proposal.branch} is deleted"])


def _remove(repo: Reader, proposal: PendingProposal) -> None:
    try:
        ProposalBranches(repo.repository).remove(proposal.branch, proposal.commit)
    except BranchMoved as moved:  # main has the answer, which stands
        errors.print(f"warning: {moved}, so it was not deleted; look at it and delete it")
    else:
        done.append(f"{proposal.branch} is deleted")
