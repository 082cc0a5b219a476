"""What GitHub's API and Gitea's, which was modelled on it, have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar
from urllib.parse import quote

from demandops.forge.api import Api, ForgeError
from demandops.forge.pull_request import PullRequest, RequestState


class PullRequestApi(ABC):
    """The pull requests of a repository."""

    NAME: ClassVar[str]
    HEADERS: ClassVar[dict[str, str]]
    EXISTS: ClassVar[int]
    """The status of the answer where there is a request for the branch already."""

    def __init__(self, api: Api, owner: str, name: str) -> None:
        self._api = api
        self._owner = owner
        self._pulls = f"/repos/{quote(owner, safe='')}/{quote(name, safe='')}/pulls"

    @abstractmethod
    def find(self, branch: str, target: str) -> PullRequest | None:
        """Return the newest pull request for a branch."""

    @abstractmethod
    def _is_merged(self, data: Any) -> bool:  # noqa: ANN401 - any JSON
        """Tell whether a pull request was merged; any lookup error where it is none."""

    def open(self, branch: str, target: str, title: str, body: str) -> PullRequest:
        """Return the pull request for a branch, or a new one where there was none."""
        found = self.find(branch, target)
        if found is not None:
            return found
        content = {"title": title, "head": branch, "base": target, "body": body}
        try:
            return self._read(self._api.call("POST", self._pulls, self.HEADERS, content))
        except ForgeError as error:
            found = self.find(branch, target) if error.status == self.EXISTS else None
            if found is None:
                raise
            return found  # the answer to an earlier call was lost

    def close(self, request: PullRequest) -> None:
        """Close a pull request."""
        path = f"{self._pulls}/{request.number}"
        self._api.call("PATCH", path, self.HEADERS, {"state": "closed"})

    def _read(self, data: Any) -> PullRequest:  # noqa: ANN401
        try:
            closed: RequestState = "merged" if self._is_merged(data) else "closed"
            state = "open" if closed == "closed" and data["state"] == "open" else closed
            return PullRequest(int(data["number"]), str(data["html_url"]), state)
        except (KeyError, TypeError, ValueError):
            message = f"the answer is no pull request; is this {self.NAME}'s API?"
            raise ForgeError(message) from None
