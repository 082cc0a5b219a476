"""Forges: where a person is asked to approve a proposal, by the API of GitHub or Gitea (Forgejo).

Knows pull requests and HTTP; nothing of demands, and nothing of Git: the branch is there already.
"""

from __future__ import annotations

from pathlib import Path

from demandops.config.repo_settings import Proposals
from demandops.forge.api import Api, ForgeError
from demandops.forge.gitea import Gitea
from demandops.forge.github import GitHub
from demandops.forge.pull_request import Forge, PullRequest

__all__ = ["Forge", "ForgeError", "PullRequest", "forge_for"]


def forge_for(proposals: Proposals, token_file: Path | None) -> Forge | None:
    """Return the forge that ``demandops.yaml`` names; nothing where it has no API to be asked.

    The token is read anew each time, so that it may be replaced while the generator runs.

    Raises:
        ForgeError: where there is no token to be read.
    """
    if proposals.forge not in ("github", "gitea") or proposals.url is None:
        return None
    owner, name = proposals.project
    token = _token(token_file, proposals.forge)
    if proposals.forge == "github":
        return GitHub(Api(proposals.api or _github_api(proposals.url), token), owner, name)
    root = proposals.url.strip("/").rsplit("/", 2)[0]
    return Gitea(Api(proposals.api or f"{root}/api/v1", token), owner, name)


def _github_api(url: str) -> str:
    scheme, _, rest = url.partition("://")
    host = rest.split("/")[0]
    return "https://api.github.com" if host == "github.com" else f"{scheme}://{host}/api/v3"


def _token(file: Path | None, forge: str) -> str:
    if file is None:
        raise ForgeError(
            f"proposals.forge is {forge}, and there is no token for it; name a file that holds one "
            "by DEMANDOPS_FORGE_TOKEN_FILE"
        )
    try:
        token = file.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise ForgeError(f"the token file {file} cannot be read: {reason}") from None
    if not token.isascii() or not token.isprintable() or not token:
        raise ForgeError(f"the token file {file} holds no token: one line of plain text")
    return token
