"""The proposals that await a person's approval, with links to their pull requests."""

from __future__ import annotations

from dataclasses import asdict

from demandops import settings
from demandops.cli.json_output import Json, time_data
from demandops.cli.output import errors
from demandops.config.repo_settings import Proposals
from demandops.errors import InvalidInput
from demandops.forge import Forge, ForgeError, forge_for
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.reader import Reader
from demandops.staterepo.write.proposal_branch import PendingProposal, pending_proposals


def proposals(repo: Reader) -> list[Json]:
    """Return the proposals as JSON data.

    The links to the pull requests come from the GitHub or Gitea that demandops.yaml names, with the
    token in the file that DEMANDOPS_FORGE_TOKEN_FILE names. If one of these is missing, or there is
    no answer or no pull request, a link is None.

    Raises:
        RemoteAway: the state repo cannot be reached.
    """
    pending = list(pending_proposals(repo.repository))
    forge = _forge(repo) if pending else None
    return [_row(each, forge) for each in pending]


def _forge(repo: Reader) -> Forge | None:
    token_file = settings.forge_token_file()
    if token_file is None:
        return None
    try:
        configured = repo.config().repo_settings.proposals
    except InvalidInput:
        configured = Proposals()  # if a file is invalid, list the proposals without links
    try:
        return forge_for(configured, token_file)
    except ForgeError as error:
        errors.print(f"warning: {error}")
        return None


def _row(proposal: PendingProposal, forge: Forge | None) -> Json:
    try:
        request = forge.find(proposal.branch, MAIN_BRANCH) if forge else None
    except ForgeError as error:
        errors.print(f"warning: {error}")
        request = None
    link = request.link if request else None
    return {"name": proposal.branch, **asdict(proposal), "since": time_data(proposal.since)} | {
        "link": link
    }
