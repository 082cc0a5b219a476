"""Pull requests of Gitea and Forgejo, by their API v1 (``/api/swagger`` of every instance)."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from generator.forge.http import Api, ForgeError
from generator.forge.request import PullRequest, RequestState

_HEADERS = {"Accept": "application/json", "Authorization": "token {token}"}
_NOT_FOUND, _EXISTS = 404, 409


class Gitea:
    """A repository on Gitea or Forgejo."""

    def __init__(self, api: Api, owner: str, name: str) -> None:
        self._api = api
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
        """Return the pull request for a branch."""
        try:  # the branch is the rest of the path, its slash as it is
            path = f"{self._pulls}/{quote(target, safe='')}/{quote(branch, safe='/')}"
            return _read(self._api.call("GET", path, _HEADERS))
        except ForgeError as error:
            if error.status == _NOT_FOUND:
                return None
            raise

    def close(self, request: PullRequest) -> None:
        """Close a pull request."""
        path = f"{self._pulls}/{request.number}"
        self._api.call("PATCH", path, _HEADERS, {"state": "closed"})


def _read(data: Any) -> PullRequest:  # noqa: ANN401
    try:
        closed: RequestState = "merged" if data["merged"] else "closed"
        state = "open" if data["state"] == "open" else closed
        return PullRequest(int(data["number"]), str(data["html_url"]), state)
    except (KeyError, TypeError, ValueError):
        raise ForgeError("the answer is no pull request; is this Gitea's API?") from None
