"""The proposals that await a person's approval, with links to their pull requests."""

from __future__ import annotations

from dataclasses import asdict

from demandops import settings
from demandops.cli.json_output import Json, time_data
from demandops.cli.output import errors
from demandops.config.repo_settings import Proposals
from demandops.errors import InvalidInput
from demandops.forge import ForgeError, forge_for
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.reader import Reader
from demandops.staterepo.write.proposal_branch import pending_proposals


def proposals(repo: Reader) -> list[Json]:
    """Return the proposals as JSON data.

    The links to the pull requests come from the GitHub or Gitea that demandops.yaml names, with the
    token in the file that DEMANDOPS_FORGE_TOKEN_FILE names. If one of these is missing, or there is
    no answer or no pull request, a link is None.
    """
    pending = list(pending_proposals(repo.repository))
    token_file, forge = settings.forge_token_file(), None
    if pending and token_file is not None:
        try:
            configured = repo.config().repo_settings.proposals
        except InvalidInput:
            configured = Proposals()  # if a file is invalid, list the proposals without links
        try:
            forge = forge_for(configured, token_file)
        except ForgeError as error:
            errors.print(f"warning: {error}")
    rows = []
    for proposal in pending:
        link = None
        try:
            request = forge.find(proposal.branch, MAIN_BRANCH) if forge else None
            link = request.link if request else None
        except ForgeError as error:
            errors.print(f"warning: {error}")
        since = time_data(proposal.since)
        rows.append({"name": proposal.branch, **asdict(proposal), "since": since, "link": link})
    return rows
