"""``demandops proposals``: which demands await a person's approval."""

from __future__ import annotations

from typing import Any

import click
from rich.table import Table

from demandops import settings
from demandops.cli.output import console, errors, output_option, print_json, state_repo_option
from demandops.config.repo_settings import Proposals
from demandops.errors import InvalidInput
from demandops.forge import Forge, ForgeError, forge_for
from demandops.settings import MAIN_BRANCH
from demandops.staterepo import reader
from demandops.staterepo.write.proposal_branch import PendingProposal


@click.command()
@state_repo_option
@output_option
def proposals(state_repo: str, output: str) -> None:
    """List the demands that await approval.

    Each is a branch of the state repo: merging it carries the demand out, deleting it turns the
    demand down. Links are asked of GitHub or Gitea where DEMANDOPS_FORGE_TOKEN_FILE names a file
    with a token.
    """
    with reader.opened(state_repo) as repo:
        found = repo.proposals()
        forge = _forge(_configured(repo)) if found else None
    rows = [_row(one, forge) for one in found]
    if output == "json":
        print_json(rows)
        return
    if not rows:
        console().print("nothing awaits approval")
        return
    table = Table()
    table.add_column("Branch", no_wrap=True)  # to be copied whole
    for name in ("Demand", "Requesters", "Since (UTC)", "What"):
        table.add_column(name)
    table.add_column("Link", overflow="fold")
    for row in rows:
        table.add_row(
            row["branch"],
            ", ".join(row["demands"]),
            ", ".join(row["requesters"]),
            row["since"][:19].replace("T", " "),
            row["summary"],
            row["link"] or "",
        )
    console().print(table)


def _configured(repo: reader.Reader) -> Proposals:
    try:
        return repo.config().repo_settings.proposals
    except InvalidInput:
        return Proposals()  # a broken file elsewhere does not hide what waits


def _forge(configured: Proposals) -> Forge | None:
    token_file = settings.forge_token_file()
    if token_file is None:
        return None
    try:
        return forge_for(configured, token_file)
    except ForgeError as error:
        errors.print(f"warning: {error}")
        return None


def _row(one: PendingProposal, forge: Forge | None) -> dict[str, Any]:
    return {
        "branch": one.branch,
        "commit": one.commit,
        "demands": list(one.demands),
        "requesters": list(one.requesters),
        "since": one.since.isoformat(),
        "summary": one.summary,
        "operations": list(one.operations),
        "link": _link(one, forge),
    }


def _link(one: PendingProposal, forge: Forge | None) -> str | None:
    try:
        request = forge.find(one.branch, MAIN_BRANCH) if forge else None
    except ForgeError as error:
        errors.print(f"warning: {error}")
        return None
    return request.link if request else None
