"""Pull requests of Gitea and Forgejo, with their API v1 (``/api/swagger`` of each instance)."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from demandops.forge.pull_requests import Forge, ForgeError, PullRequest

_NOT_FOUND = 404


class Gitea(Forge):
    """The pull requests of a repository on Gitea or Forgejo."""

    NAME = "Gitea"
    HEADERS = {"Accept": "application/json", "Authorization": "token {token}"}  # noqa: RUF012
    EXISTS = 409

    def find(self, branch: str, target: str) -> PullRequest | None:
        """Return the pull request for a branch."""
        try:  # the branch ends the path, so its slash stays unquoted
            path = f"{self._pulls}/{quote(target, safe='')}/{quote(branch, safe='/')}"
            return self._read(self._call("GET", path))
        except ForgeError as error:
            if error.status == _NOT_FOUND:
                return None
            raise

    def _is_merged(self, data: Any) -> bool:  # noqa: ANN401
        return bool(data["merged"])
