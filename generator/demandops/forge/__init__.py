"""Forges: opens pull requests for proposals, with the API of GitHub or Gitea (Forgejo).

Knows pull requests and HTTP, but not demands or Git: the branch has already been pushed. GitLab
needs no call: it opens a merge request because of the push's options
(:mod:`demandops.staterepo.write.proposal_branch`).
"""

from __future__ import annotations

from pathlib import Path

from demandops.config.repo_settings import Proposals
from demandops.forge.gitea import Gitea
from demandops.forge.github import GitHub
from demandops.forge.pull_requests import Forge, ForgeError, PullRequest

__all__ = ["Forge", "ForgeError", "PullRequest", "forge_for"]


def forge_for(proposals: Proposals, token_file: Path | None) -> Forge | None:
    """Return the forge that ``demandops.yaml`` names, or ``None`` if its API is not supported.

    Each call reads the token again, so that it can be replaced while the generator runs.

    Raises:
        ForgeError: if the token cannot be read.
    """
    if proposals.forge not in ("github", "gitea") or proposals.url is None:
        return None
    owner, name = proposals.project
    token = _token(token_file, proposals.forge)
    if proposals.forge == "github":
        return GitHub(proposals.api or _github_api(proposals.url), token, owner, name)
    root = proposals.url.strip("/").rsplit("/", 2)[0]
    return Gitea(proposals.api or f"{root}/api/v1", token, owner, name)


def _github_api(url: str) -> str:
    scheme, _, rest = url.partition("://")
    host = rest.split("/")[0]
    return "https://api.github.com" if host == "github.com" else f"{scheme}://{host}/api/v3"


def _token(file: Path | None, forge: str) -> str:
    if file is None:
        raise ForgeError(
            f"proposals.forge is {forge}, but there is no token for it; set "
            "DEMANDOPS_FORGE_TOKEN_FILE to a file that holds one"
        )
    try:
        token = file.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise ForgeError(f"the token file {file} cannot be read: {reason}") from None
    if not token.isascii() or not token.isprintable() or not token:
        raise ForgeError(f"the token file {file} must hold a token: one line of plain text")
    return token
