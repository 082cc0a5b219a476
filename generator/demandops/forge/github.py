"""GitHub's pull requests, with its REST API in version 2022-11-28.

https://docs.github.com/en/rest/pulls/pulls
"""

from __future__ import annotations

from typing import Any
from urllib.parse import urlencode

from demandops.forge.pull_requests import Forge, PullRequest


class GitHub(Forge):
    """The pull requests of a repository on GitHub."""

    NAME = "GitHub"
    HEADERS = {  # noqa: RUF012
        "Accept": "application/vnd.github+json",
        "Authorization": "Bearer {token}",
        "X-GitHub-Api-Version": "2022-11-28",
    }
    EXISTS = 422

    def find(self, branch: str, target: str) -> PullRequest | None:
        """Return the newest pull request for a branch."""
        query = {
            "head": f"{self._owner}:{branch}",
            "base": target,
            "state": "all",
            "sort": "created",
            "direction": "desc",
            "per_page": "1",
        }
        answer = self._call("GET", f"{self._pulls}?{urlencode(query)}")
        return self._read(answer[0]) if isinstance(answer, list) and answer else None

    def _is_merged(self, data: Any) -> bool:  # noqa: ANN401
        return data["merged_at"] is not None
