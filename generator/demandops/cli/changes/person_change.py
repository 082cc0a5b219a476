"""Shared parts of the commands by which a person edits the state repo."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import wraps
from pathlib import Path
from typing import Any

import click

from demandops.base import settings
from demandops.base.quoting import harmless, one_line
from demandops.base.runtime import REAL
from demandops.base.settings import MAIN_BRANCH
from demandops.cli import json_output, target
from demandops.cli.json_output import Json
from demandops.cli.output import done, errors, progress
from demandops.model.config.base_model import parse_file
from demandops.model.config.override import Override, OverrideFile
from demandops.model.ledger.ledger import World
from demandops.repo import reader
from demandops.repo.forge import ForgeError, forge_for
from demandops.repo.git.signing import Signer
from demandops.repo.history.commit_log import Person
from demandops.repo.reader import Reader
from demandops.repo.write import person_commit
from demandops.repo.write.person_commit import CommitDetails, Published
from demandops.serve.approvals.proposal import merge_request
from demandops.views.release_causes import Entry, override_report

reason_option = click.option(
    "-m",
    "--reason",
    metavar="TEXT",
    callback=lambda ctx, param, text: " ".join((text or "").split()),
    help="The reason. It is written to the commit message and to the file of a new override.",
)
yes_option = click.option("-y", "--yes", is_flag=True, help="Do not ask for confirmation.")
propose_option = click.option(
    "--propose",
    is_flag=True,
    help="Push a branch instead of committing to main. If demandops.yaml names a forge, also open "
    "a merge request.",
)


def is_asked(yes: bool, output: str) -> bool:
    return not yes and output == "text" and sys.stdin.isatty()


def confirm(question: str, yes: bool, output: str) -> None:
    if is_asked(yes, output) and not click.confirm(question, err=True):
        raise click.ClickException("nothing was changed")


def warned_if_unnamed(person: Person) -> Person:
    if not person.is_known:
        errors.print(
            f"warning: git does not know who you are, so the commit's author is {person}; to "
            'change that: git config --global user.name "Your Name" and '
            "git config --global user.email you@example.org"
        )
    return person


@contextmanager
def writable(
    state_repo: str, signing_key: Path | None, *, dry_run: bool = False
) -> Iterator[Reader]:
    # a dry run writes nothing, so the state repo may also be a checkout
    with reader.opened(state_repo, only_read=dry_run) as repo:
        repo.repository.signer = Signer(signing_key) if signing_key else None
        yield repo


@dataclass(frozen=True, slots=True)
class EditOptions:
    state_repo: str
    signing_key: Path | None
    reason: str
    propose: bool
    dry_run: bool
    yes: bool
    output: str


def editing(command: target.Command) -> target.Command:
    # the command gets the values of these options as `options`

    @wraps(command)
    def run(**given: Any) -> Any:  # noqa: ANN401
        options = EditOptions(
            **{field.name: given.pop(field.name) for field in fields(EditOptions)}
        )
        return command(options=options, **given)

    options = (
        reason_option,
        propose_option,
        target.dry_run_option,
        yes_option,
        target.writable_repo_option,
        target.signing_option,
        json_output.output_option,
    )
    added: target.Command = run
    for option in reversed(options):
        added = option(added)
    return added


@dataclass(frozen=True, slots=True)
class Edit:
    name: str  # of the override
    text: str | None  # None removes the file
    summary: str  # of the commit
    reason: str

    @property
    def path(self) -> str:
        return f"overrides/{self.name}.yaml"


def consequence(repo: Reader, edit: Edit) -> Entry:
    """Return the edited override as if it were on main, and what it affects."""
    with progress("reading the ledger") as report:
        state = repo.snapshot(progress=report).state
    world = World(state.config, state.ledger)
    if edit.text is not None:
        override = Override.from_file(edit.name, parse_file(OverrideFile, edit.text, edit.path))
        overrides = {**state.config.overrides, edit.name: override}
        world = World(replace(state.config, overrides=overrides), state.ledger)
    entries = override_report(world, REAL.now())
    return next(entry for entry in entries if entry.override.name == edit.name)


def carry_out(repo: Reader, edit: Edit, propose: bool) -> Published:
    files = {edit.path: edit.text}
    details = CommitDetails(
        warned_if_unnamed(repo.operator()), REAL.now(), edit.summary, one_line(edit.reason)
    )
    if not propose:
        committed = person_commit.commit_to_main(repo.repository, files, details)
        done.append(f"commit {committed.commit} on {MAIN_BRANCH}")
        return committed
    branch = f"override/{edit.name}"
    title, reason = harmless(one_line(edit.summary)), one_line(edit.reason)
    proposals = repo.snapshot().state.config.repo_settings.proposals
    # only GitLab opens a merge request for a push
    push_options = merge_request(title, reason) if proposals.forge == "gitlab" else []
    pushed = person_commit.commit_to_branch(repo.repository, files, details, branch, push_options)
    done.append(f"commit {pushed.commit} on {branch}")
    link = pushed.link
    try:
        if not link and (forge := forge_for(proposals, settings.forge_token_file())):
            link = forge.open(branch, MAIN_BRANCH, title, reason).link
    except ForgeError as error:  # the branch is there, so a person can open the merge request
        errors.print(f"warning: no merge request was opened: {error}; open one for {branch}")
    return Published(pushed.commit, branch, link)


def print_edit(edit: Edit, entry: Entry, published: Published | None, output: str) -> None:
    outcome = "would-change"
    if published:
        outcome = "committed" if published.branch == MAIN_BRANCH else "proposed"
    data: Json = {
        "outcome": outcome,
        "commit": published.commit if published else None,
        "branch": published.branch if published else None,
        "link": published.link or None if published else None,
        "text": edit.text,
        "override": json_output.override_data(entry.override),
        "state": entry.state,
        "releases": [json_output.release_data(release) for release in entry.releases],
        "claims": [json_output.claim_data(claim) for claim in entry.claims],
    }
    if outcome == "committed":
        lines = [
            f"{edit.summary}: commit {data['commit']} on {MAIN_BRANCH}",
            "a running generator carries out this commit, or else the next generator that starts",
            *target.hint_to_pull(),
        ]
    elif outcome == "proposed":
        lines = [f"{edit.summary}: merge {data['branch']} {data['link'] or ''}".rstrip()]
    else:
        text = (edit.text or "").splitlines()
        lines = [f"{edit.summary}: nothing was changed", *(f"    {line}" for line in text)]
    json_output.show(output, data, lines)


selecting = target.name_options(
    {
        name: f"Select this {name}; * matches any text, ? one character. May be repeated."
        for name in ("application", "appdef", "service", "connection", "node", "requester")
    },
    metavar="NAME",
    multiple=True,
)


def selector(given: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    return {name: list(values) for name, values in given.items() if values}
