"""``demandops proposals``: the demands that await a person's approval."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import click
from rich.table import Table

from demandops import settings
from demandops.cli.json_output import output_option, show, time_data, time_text
from demandops.cli.output import errors, state_repo_option
from demandops.config.repo_settings import Proposals
from demandops.errors import InvalidInput
from demandops.forge import Forge, ForgeError, forge_for
from demandops.settings import MAIN_BRANCH
from demandops.staterepo import reader
from demandops.staterepo.write.proposal_branch import PendingProposal, pending_proposals


@click.command()
@state_repo_option
@output_option
def proposals(state_repo: str, output: str) -> None:
    """List the demands that await approval.

    Each is a branch of the state repo. Merge the branch to approve the demand; delete it to refuse
    the demand. If DEMANDOPS_FORGE_TOKEN_FILE names a file with a token, links to pull requests are
    read from GitHub or Gitea.
    """
    with reader.opened(state_repo) as repo:
        pending = list(pending_proposals(repo.repository))
        forge = _forge(repo) if pending else None
    rows = [_row(each, forge) for each in pending]
    show(output, rows, [_table(rows) if rows else "nothing awaits approval"])


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table()
    table.add_column("Branch", no_wrap=True)  # so that it can be copied
    for name in ("Demand", "Requesters", "Since (UTC)", "What"):
        table.add_column(name)
    table.add_column("Link", overflow="fold")
    for row in rows:
        table.add_row(
            row["branch"],
            ", ".join(row["demands"]),
            ", ".join(row["requesters"]),
            time_text(row["since"]).removesuffix(" UTC"),
            row["summary"],
            row["link"] or "",
        )
    return table


def _forge(repo: reader.Reader) -> Forge | None:
    token_file = settings.forge_token_file()
    if token_file is None:
        return None
    try:
        configured = repo.config().repo_settings.proposals
    except InvalidInput:
        configured = Proposals()  # an invalid file elsewhere must not hide the proposals
    try:
        return forge_for(configured, token_file)
    except ForgeError as error:
        errors.print(f"warning: {error}")
        return None


def _row(proposal: PendingProposal, forge: Forge | None) -> dict[str, Any]:
    try:
        request = forge.find(proposal.branch, MAIN_BRANCH) if forge else None
    except ForgeError as error:
        errors.print(f"warning: {error}")
        request = None
    link = request.link if request else None
    return asdict(proposal) | {"since": time_data(proposal.since), "link": link}
