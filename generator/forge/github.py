"""GitHub's pull requests, by its REST API in version 2022-11-28.

https://docs.github.com/en/rest/pulls/pulls
"""

from __future__ import annotations

from typing import Any
from urllib.parse import quote, urlencode

from generator.forge.http import Api, ForgeError
from generator.forge.request import PullRequest, RequestState

_HEADERS = {
    "Accept": "application/vnd.github+json",
    "Authorization": "Bearer {token}",
    "X-GitHub-Api-Version": "2022-11-28",
}
_EXISTS = 422


class GitHub:
    """A repository on GitHub."""

    def __init__(self, api: Api, owner: str, name: str) -> None:
        self._api = api
        self._owner = owner
        self._pulls = f"/repos/{quote(owner, safe='')}/{quote(name, safe='')}/pulls"

    def open(self, branch: str, target: str, title: str, body: str) -> PullRequest:
        """Return the pull request for a branch, or a new one where there was none."""
        found = self.find(branch, target)
        if found is not None:
            return found
        content = {"title": title, "head": branch, "base": target, "body": body}
        try:
            return _read(self._api.call("POST", self._pulls, _HEADERS, content))
        except ForgeError as error:
            found = self.find(branch, target) if error.status == _EXISTS else None
            if found is None:
                raise
            return found  # the answer to an earlier call was lost

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
        found = self._api.call("GET", f"{self._pulls}?{urlencode(query)}", _HEADERS)
        return _read(found[0]) if isinstance(found, list) and found else None

    def close(self, request: PullRequest) -> None:
        """Close a pull request."""
        path = f"{self._pulls}/{request.number}"
        self._api.call("PATCH", path, _HEADERS, {"state": "closed"})


def _read(data: Any) -> PullRequest:  # noqa: ANN401
    try:
        merged = data["merged_at"] is not None
        state: RequestState = (
            "merged" if merged else "open" if data["state"] == "open" else "closed"
        )
        return PullRequest(int(data["number"]), str(data["html_url"]), state)
    except (KeyError, TypeError, ValueError):
        raise ForgeError("the answer is no pull request; is this GitHub's API?") from None
