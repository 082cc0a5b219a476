"""Pull requests at a forge, and the HTTP calls that GitHub and Gitea share."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal
from urllib.parse import quote

from demandops import http_call
from demandops.errors import DemandOpsError, quoted

_TIMEOUT_S = 15.0

PullRequestState = Literal["open", "merged", "closed"]


class ForgeError(DemandOpsError):
    """Raised when a forge fails or refuses; ``status`` is its HTTP status, if it answered.

    No message contains the token.
    """

    def __init__(self, message: str, status: int | None = None) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True, slots=True)
class PullRequest:
    """A request to merge a branch: its number, its web page and its state."""

    number: int
    link: str
    state: PullRequestState


class Forge(ABC):
    """A project on a forge. Every method raises ``ForgeError`` if the forge fails or refuses."""

    NAME: ClassVar[str]
    HEADERS: ClassVar[dict[str, str]]
    """The HTTP headers of each call, with ``{token}`` for the token."""
    EXISTS: ClassVar[int]
    """The HTTP status of a refusal because the branch already has a pull request."""

    def __init__(self, api: str, token: str, owner: str, name: str) -> None:
        self._api = api.rstrip("/")
        self._token = token
        self._owner = owner
        self._pulls = f"/repos/{quote(owner, safe='')}/{quote(name, safe='')}/pulls"

    @abstractmethod
    def find(self, branch: str, target: str) -> PullRequest | None:
        """Return the newest pull request for a branch in any state, or ``None``."""

    @abstractmethod
    def _is_merged(self, data: Any) -> bool:  # noqa: ANN401 - any JSON
        """Report whether a pull request was merged; raises a lookup error for other data."""

    def open(self, branch: str, target: str, title: str, body: str) -> PullRequest:
        """Return the pull request for a branch; open one if there is none.

        A branch gets only one pull request, so a closed one is not opened again.
        """
        existing = self.find(branch, target)
        if existing is not None:
            return existing
        content = {"title": title, "head": branch, "base": target, "body": body}
        try:
            return self._read(self._call("POST", self._pulls, content))
        except ForgeError as error:
            existing = self.find(branch, target) if error.status == self.EXISTS else None
            if existing is None:
                raise
            return existing  # the answer to an earlier call was lost

    def close(self, request: PullRequest) -> None:
        """Close a pull request without merging it."""
        self._call("PATCH", f"{self._pulls}/{request.number}", {"state": "closed"})

    def _call(self, method: str, path: str, body: Mapping[str, object] | None = None) -> Any:  # noqa: ANN401 - the caller knows the answer's form
        """Send JSON to a path below the API's address and return the answer's JSON."""
        where = f"{method} {self._api}{path}"
        headers = {key: value.format(token=self._token) for key, value in self.HEADERS.items()}
        content = None
        if body is not None:
            content = json.dumps(body).encode()
            headers["Content-Type"] = "application/json"
        try:
            answer = http_call.call(method, self._api + path, headers, content, _TIMEOUT_S)
        except http_call.NoAnswer as error:
            raise ForgeError(f"{where}: {error}") from None
        data, is_json = _json(answer.body)
        if not answer.is_success:
            reason = _reason(data if isinstance(data, dict) else {"message": answer.reason})
            moved = "; redirects are not followed: check the API's address"
            remedy = moved if answer.is_redirect else ""
            raise ForgeError(f"{where}: {answer.status} {reason}{remedy}", answer.status)
        if not is_json:
            raise ForgeError(f"{where}: the answer is not JSON; check the API's address")
        return data

    def _read(self, data: Any) -> PullRequest:  # noqa: ANN401
        try:
            closed: PullRequestState = "merged" if self._is_merged(data) else "closed"
            state = "open" if closed == "closed" and data["state"] == "open" else closed
            return PullRequest(int(data["number"]), str(data["html_url"]), state)
        except (KeyError, TypeError, ValueError):
            message = f"the answer is not a pull request; check that this is {self.NAME}'s API"
            raise ForgeError(message) from None


def _json(body: bytes) -> tuple[Any, bool]:
    try:
        return (json.loads(body) if body.strip() else None), True
    except (ValueError, RecursionError):
        return None, False


def _reason(answer: Mapping[str, Any]) -> str:
    """Return a forge's reason for a refusal: its ``message`` and the messages in ``errors``."""
    details = answer.get("errors")
    texts = [answer.get("message"), *(details if isinstance(details, list) else ())]
    texts = [text.get("message") if isinstance(text, dict) else text for text in texts]
    return quoted("; ".join(text for text in texts if isinstance(text, str) and text), 300)
