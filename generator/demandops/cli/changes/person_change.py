"""How a person changes a state repo: a command decides, shows what follows, asks, and acts.

The commands ``approve`` and ``reject`` are here, by which a person answers a proposal.

What a person configures is a commit in their own name, on main or on a branch to be merged
(:func:`commit`). What they end or restore in the ledger is booked like a demand
(:mod:`.ledger_change`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import wraps
from pathlib import Path
from typing import Any

import click

from demandops.base import settings
from demandops.base.errors import InvalidInput, suggestion
from demandops.base.quoting import count, harmless, one_line
from demandops.base.runtime import REAL
from demandops.base.settings import MAIN_BRANCH
from demandops.cli import formats, target
from demandops.cli.output import busy, done, errors, fitted, terminal_width
from demandops.cli.queries.commits import differences, entry_lines, release_lines
from demandops.decide.planning.overrides import suspended_claims
from demandops.decide.state import FileChange, ReleaseChange, State, described, planned_releases
from demandops.model.ledger.claim import requesters_of
from demandops.model.release import Release, ServiceRelease, claims_of
from demandops.render import gitops
from demandops.render.gitops import path_of
from demandops.repo import reader
from demandops.repo.forge import ForgeError, forge_for
from demandops.repo.git.repository import PushDenied
from demandops.repo.git.signing import Signer
from demandops.repo.history.commit_log import Person
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
from demandops.serve.proposal import merge_request
from demandops.views import vocabulary
from demandops.views.vocabulary import Json

# ---- the options of all these commands ----

propose_option = click.option(
    "--propose",
    is_flag=True,
    help="Push a branch instead of committing to main. If demandops.yaml names a forge, also open "
    "a merge request.",
)


@dataclass(frozen=True, slots=True)
class Options:
    state_repo: str
    signing_key: Path | None
    reason: str
    yes: bool
    output: str
    dry_run: bool = False
    propose: bool = False

    def with_reason(self) -> Options:
        reason = self.reason
        if not reason and sys.stdin.isatty() and not self.yes:
            reason = " ".join(click.prompt("Why", err=True).split())
        if not reason:
            raise click.UsageError("give the reason: -m TEXT")
        return replace(self, reason=reason)


def changing(*more: target.Decorator, dry_run: bool = True) -> target.Decorator:
    # the command gets the values of these options as `options`
    def add(command: target.Command) -> target.Command:
        @wraps(command)
        def run(**given: Any) -> Any:  # noqa: ANN401
            names = [field.name for field in fields(Options) if field.name in given]
            return command(options=Options(**{name: given.pop(name) for name in names}), **given)

        return target.with_options(
            click.option(
                "-m",
                "--reason",
                metavar="TEXT",
                callback=lambda ctx, param, text: " ".join((text or "").split()),
                help="Why; the commit message says it, and the file of an override.",
            ),
            *more,
            *([target.dry_run_option] if dry_run else []),
            click.option(
                "-y", "--yes", is_flag=True, help="Do not ask. Needed where there is no terminal."
            ),
            target.writable_repo_option,
            target.signing_option,
            formats.output_option,
        )(run)

    return add


# ---- what follows, and the question ----

_MOST_SHOWN = 30


def confirm(question: str, yes: bool) -> None:
    if not yes and not sys.stdin.isatty():
        raise click.ClickException(
            "nothing was changed, because nobody can be asked here; if you mean it, give --yes"
        )
    if not yes and not click.confirm(question, err=True):
        raise click.ClickException("nothing was changed")


def consequence(
    releases: Collection[ReleaseChange],
    who: Collection[str],
    claims: Collection[object] = (),
    stopped: int | None = None,
) -> Iterator[str]:
    """Yield the lines about the releases that change, and in capitals what stops or is released.

    ``claims`` are those that are released or reduced, ``who`` are their requesters, or those of the
    releases that stop. ``stopped`` is the number of these, by default of those that are removed.
    """
    yield from (f"  {line}" for line in release_lines([*releases][:_MOST_SHOWN]))
    if len(releases) > _MOST_SHOWN:
        yield f"  and {count(len(releases) - _MOST_SHOWN, 'more release')} (-o json lists all)"
    if stopped is None:
        stopped = sum(release.change == "stop" for release in releases)
    verbs = [f"RELEASES {count(len(claims), 'claim')}"] if claims else []
    verbs += [f"STOPS {count(stopped, 'release')}"] if stopped else []
    if verbs:
        yield f"{' and '.join(verbs)} of {count(len(who), 'requester')}"
    elif not releases:
        yield "  stops and changes nothing that runs"


def warned_if_unnamed(person: Person) -> Person:
    if not person.is_known:
        errors.print(
            f"warning: git does not know who you are, so the commit's author is {person}; to "
            'change that: git config --global user.name "Your Name" and '
            "git config --global user.email you@example.org"
        )
    return person


# ---- a commit of a person ----


def _runs(release: Release | None) -> bool:
    return release is not None and not (
        isinstance(release, ServiceRelease) and release.replicas == 0
    )


@contextmanager
def writable(options: Options) -> Iterator[Reader]:
    # a dry run writes nothing, so the state repo may also be a checkout
    with reader.opened(options.state_repo, only_read=options.dry_run) as repo:
        repo.repository.signer = Signer(options.signing_key) if options.signing_key else None
        yield repo


def commit(
    repo: Reader,
    files: Mapping[str, str | None],
    summary: str,
    branch: str,
    options: Options,
    more: Callable[[State, State], tuple[Json, Iterable[str]]],
) -> None:
    """Commit files to main, or to ``branch``, once the person has seen what follows.

    ``more`` returns further JSON and further lines about the state before and after.
    """
    with busy("reading the ledger") as report:
        before = repo.snapshot(progress=report)
        after = person_commit.state_after(repo.repository, before, files)

    def text(release: Release | None, state: State) -> str | None:
        with suppress(InvalidInput):
            return gitops.render(release, state.config, state.evaluate) if release else None
        return None

    old, new = planned_releases(before.state), planned_releases(after)
    changes = []
    for key in {**old, **new}:
        was, now = old.get(key), new.get(key)
        # a release also has what no file shows, such as whether its node is drained
        if was != now:
            change = described(was, now, text(was, before.state), text(now, after))
            changes += [change] if change.change != "change" or change.details else []
    changes.sort(key=lambda change: (change.change, change.name))
    ended = (each for key, each in old.items() if _runs(each) and not _runs(new.get(key)))
    read = repo.file_reader()  # what has no file has not started yet
    stopped = [release for release in ended if read(path_of(release)) is not None]
    who = {name for r in stopped for name in requesters_of(claims_of(r, before.state.ledger))}
    suspended = {claim.key for claim, _ in suspended_claims(before.state)}
    claims = [claim for claim, _ in suspended_claims(after) if claim.key not in suspended]
    of_command, lines = more(before.state, after)
    told = [f"{summary} ({', '.join(files)})", *lines, *consequence(changes, who, (), len(stopped))]
    told = [fitted(line, terminal_width()) for line in told]
    data: Json = {
        "outcome": "would-change",
        "commit": None,
        "branch": None,
        "link": None,
        "files": dict(files),
        "releases": [asdict(change) for change in changes],
        "claims": [vocabulary.claim_data(claim) for claim in claims],
        **of_command,
    }
    if options.dry_run:
        shown = list[str]()
        for path, content in files.items():
            file = FileChange(path, read(path), content)
            diff = file.diff() if file.before else (content or "").splitlines()
            shown += [f"    {line}" for line in diff]
        formats.show(options.output, data, [*told, *shown, "nothing was changed"])
        return
    for line in told if options.output == "text" else ():
        errors.print(line)
    confirm("Continue?", options.yes)
    reason, person = one_line(options.reason), warned_if_unnamed(repo.operator())
    details = CommitDetails(person, REAL.now(), summary, reason)
    if not options.propose:
        published = person_commit.commit_to_main(repo.repository, files, details)
        told = [
            f"{summary}: commit {published.commit} on {MAIN_BRANCH}",
            "a running generator carries out this commit, or else the next generator that starts",
            *target.hint_to_pull(),
        ]
    else:
        title, proposals = harmless(one_line(summary)), before.state.config.repo_settings.proposals
        # only GitLab opens a merge request for a push
        asked = merge_request(title, reason) if proposals.forge == "gitlab" else []
        published = person_commit.commit_to_branch(repo.repository, files, details, branch, asked)
        data["link"] = published.link or None
        try:
            if not published.link and (forge := forge_for(proposals, settings.forge_token_file())):
                data["link"] = forge.open(branch, MAIN_BRANCH, title, reason).link
        except ForgeError as error:  # the branch is there, so a person can open the merge request
            errors.print(f"warning: no merge request was opened: {error}; open one for {branch}")
        told = [f"{summary}: merge {branch} {data['link'] or ''}".rstrip()]
    done.append(f"commit {published.commit} on {published.branch}")
    data |= {
        "outcome": "proposed" if options.propose else "committed",
        "commit": published.commit,
        "branch": published.branch,
    }
    formats.show(options.output, data, told)


# ---- ``demandops approve``: merge a proposal in the caller's own name ----

_named = click.argument(
    "name", metavar="BRANCH|DEMAND", shell_complete=target.names_of("proposals")
)
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
    """At a terminal, the command first shows what the merge would change, and asks. Elsewhere, and
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
            "name the commit that you looked at: --commit ID; `demandops get proposals -o wide` "
            "has the whole command"
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
        told = f"{proposal.branch} is merged in {merged.commit}"
        done.append(told)
        if proposal.branch.startswith(OF_PEOPLE):  # a generator removes only its own branches
            _remove(repo, proposal)
    data = {"outcome": "approved", "branch": proposal.branch, "commit": merged.commit}
    formats.show(options.output, data, [f"approved: {told}"])


# ---- ``demandops reject``: refuse a proposal ----


@click.command()
@_named
@_answering
def reject(name: str, commit: str, options: Options) -> None:
    """The requester gets the reason, which must be given; the generator aborts the goal with
    `turned-down`. If the branch has changed since the command read it, the command changes nothing.

    \b
    Examples:
      demandops reject visit -m "The road is closed"
      demandops reject demand/visit-3f2a9c1b04de -m "Out of hours" --yes
    """
    with writable(options) as repo:
        proposal = _proposal(repo, name, commit, options.output)
        options = options.with_reason()
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
    formats.show(options.output, data, [f"rejected: {where}{proposal.branch} is deleted"])


def _remove(repo: Reader, proposal: PendingProposal) -> None:
    try:
        ProposalBranches(repo.repository).remove(proposal.branch, proposal.commit)
    except BranchMoved as moved:  # main has the answer, which stands
        errors.print(f"warning: {moved}, so it was not deleted; look at it and delete it")
    else:
        done.append(f"{proposal.branch} is deleted")
