"""The pull request API that GitHub and Gitea share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar
from urllib.parse import quote

from demandops.forge.api import Api, ForgeError
from demandops.forge.pull_request import PullRequest, RequestState


class PullRequestApi(ABC):
    """The pull requests of a repository on a forge."""

    NAME: ClassVar[str]
    HEADERS: ClassVar[dict[str, str]]
    EXISTS: ClassVar[int]
    """The HTTP status of a refusal because the branch already has a pull request."""

    def __init__(self, api: Api, owner: str, name: str) -> None:
        self._api = api
        self._owner = owner
        self._pulls = f"/repos/{quote(owner, safe='')}/{quote(name, safe='')}/pulls"

    @abstractmethod
    def find(self, branch: str, target: str) -> PullRequest | None:
        """Return the newest pull request for a branch, or ``None``."""

    @abstractmethod
    def _is_merged(self, data: Any) -> bool:  # noqa: ANN401 - any JSON
        """Report whether a pull request was merged; raises a lookup error for other data."""

    def open(self, branch: str, target: str, title: str, body: str) -> PullRequest:
        """Return the pull request for a branch; open one if there is none."""
        existing = self.find(branch, target)
        if existing is not None:
            return existing
        content = {"title": title, "head": branch, "base": target, "body": body}
        try:
            return self._read(self._api.call("POST", self._pulls, self.HEADERS, content))
        except ForgeError as error:
            existing = self.find(branch, target) if error.status == self.EXISTS else None
            if existing is None:
                raise
            return existing  # the answer to an earlier call was lost

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
            message = f"the answer is not a pull request; check that this is {self.NAME}'s API"
            raise ForgeError(message) from None
