"""Pull requests for proposals, at a forge: GitHub, Gitea or Forgejo.

This module knows pull requests and HTTP, but not demands or Git. Its callers push the branch.
GitLab needs no call, because it opens a merge request if the push has the right options
(:mod:`.proposal_branch`).
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal
from urllib.parse import quote, urlencode, urlsplit

from demandops.base import http_call
from demandops.base.errors import DemandOpsError, InvalidInput
from demandops.base.quoting import quoted
from demandops.base.strict_yaml import read_secret
from demandops.model.config.repo_settings import Proposals

_TIMEOUT_S = 15.0
_NO_JSON = object()  # null is JSON, so None cannot say it

PullRequestState = Literal["open", "merged", "closed"]


class ForgeError(DemandOpsError):
    """Raised when a call of a forge fails, or cannot be made. No message contains the token.

    ``status`` is the HTTP status with which the forge refused the call. It is None if the forge
    gives no answer, or none that can be read. ``asks_to_wait`` says whether the forge asks to call
    again later, mostly because it got too many calls.
    """

    def __init__(
        self, message: str, status: int | None = None, *, asks_to_wait: bool = False
    ) -> None:
        super().__init__(message)
        self.status, self.asks_to_wait = status, asks_to_wait


@dataclass(frozen=True, slots=True)
class PullRequest:
    number: int
    link: str
    state: PullRequestState


class Forge(ABC):
    """A project on a forge. Every method raises :class:`ForgeError` if a call fails."""

    NAME: ClassVar[str]
    # The HTTP headers of each call, with `{token}` for the token
    HEADERS: ClassVar[dict[str, str]]
    # The last part of the path of a commit's pull requests
    OF_COMMIT: ClassVar[str]
    # The field of a pull request that says whether it is merged
    MERGED: ClassVar[str]
    # The HTTP status with which the forge refuses a second pull request for a branch
    EXISTS: ClassVar[int]

    def __init__(self, api: str, token: str, owner: str, name: str) -> None:
        self._api = api.rstrip("/")
        self._token = token
        self._owner = owner
        self._project = f"/repos/{quote(owner, safe='')}/{quote(name, safe='')}"
        self._pulls = f"{self._project}/pulls"

    @abstractmethod
    def find(self, branch: str, target: str) -> PullRequest | None:
        """Return the pull request from a branch to ``target``, open or not, or None."""

    def open(self, branch: str, target: str, title: str, body: str) -> PullRequest:
        """Return the pull request from a branch to ``target``; create it if there never was one.

        An existing one keeps its title and body.
        """
        existing = self.find(branch, target)
        if existing is not None:  # a branch gets only one, so a closed one is returned as it is
            return existing
        content = {"title": title, "head": branch, "base": target, "body": body}
        try:
            return self._read(self._call("POST", self._pulls, content))
        except ForgeError as error:
            existing = self.find(branch, target) if error.status == self.EXISTS else None
            if existing is None:
                raise
            return existing  # an earlier call opened it, but its answer was lost

    def close(self, request: PullRequest, body: str) -> None:
        # the text says why, because a comment would need a further permission of the token
        self._call("PATCH", f"{self._pulls}/{request.number}", {"state": "closed", "body": body})

    def comment(self, commit: str, text: str) -> None:
        """Comment on the pull requests whose merge brought a commit to main, if there are any."""
        try:
            found = self._call("GET", f"{self._project}/commits/{commit}/{self.OF_COMMIT}")
        except ForgeError as error:
            if error.status in (404, 409, 422):  # it came by a push, or the forge has not seen it
                return
            raise
        for data in found if isinstance(found, list) else [found]:
            path = f"{self._project}/issues/{self._read(data).number}/comments"
            self._call("POST", path, {"body": text})

    def _call(self, method: str, path: str, body: Mapping[str, object] | None = None) -> Any:  # noqa: ANN401 - the caller knows the answer's form
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
        try:
            data = json.loads(answer.body or b"null")
        except (ValueError, RecursionError):
            data = _NO_JSON
        if not answer.is_success:
            refusal = data if isinstance(data, dict) else {"message": answer.reason}
            details = refusal.get("errors")
            texts = [refusal.get("message"), *(details if isinstance(details, list) else ())]
            texts = [text.get("message") if isinstance(text, dict) else text for text in texts]
            reason = "; ".join(text for text in texts if isinstance(text, str) and text)
            reason = quoted(reason.replace(self._token, "…"), 300)  # a server may repeat the token
            if 300 <= answer.status < 400:
                reason += "; redirects are not followed: check the API's address"
            text = f"{where}: {answer.status} {reason}"
            raise ForgeError(text, answer.status, asks_to_wait=answer.asks_to_wait)
        if data is _NO_JSON:
            raise ForgeError(f"{where}: the answer is not JSON; check the API's address")
        return data

    def _read(self, data: Any) -> PullRequest:  # noqa: ANN401
        try:
            # a merged pull request has the state "closed" too
            closed: PullRequestState = "merged" if data[self.MERGED] else "closed"
            state = "open" if closed == "closed" and data["state"] == "open" else closed
            link = str(data["html_url"])
            if not link.isprintable():
                raise ValueError("the link is more than one line")
            return PullRequest(int(data["number"]), link, state)
        except (KeyError, TypeError, ValueError, OverflowError):
            message = f"{self._api}: the answer is not a pull request; check that this is the "
            message += f"address of {self.NAME}'s API"
            raise ForgeError(message) from None


class GitHub(Forge):
    """GitHub, by its REST API of version 2022-11-28: https://docs.github.com/en/rest/pulls/pulls."""

    NAME = "GitHub"
    HEADERS = {  # noqa: RUF012
        "Accept": "application/vnd.github+json",
        "Authorization": "Bearer {token}",
        "X-GitHub-Api-Version": "2022-11-28",
    }
    OF_COMMIT = "pulls"
    MERGED = "merged_at"
    EXISTS = 422

    def find(self, branch: str, target: str) -> PullRequest | None:
        query = {  # the newest of them
            "head": f"{self._owner}:{branch}",
            "base": target,
            "state": "all",
            "sort": "created",
            "direction": "desc",
            "per_page": "1",
        }
        answer = self._call("GET", f"{self._pulls}?{urlencode(query)}")
        return self._read(answer[0]) if isinstance(answer, list) and answer else None


class Gitea(Forge):
    """Gitea or Forgejo, by the API v1 that ``/api/swagger`` of each instance describes."""

    NAME = "Gitea"
    HEADERS = {"Accept": "application/json", "Authorization": "token {token}"}  # noqa: RUF012
    OF_COMMIT = "pull"
    MERGED = "merged"
    EXISTS = 409

    def find(self, branch: str, target: str) -> PullRequest | None:
        try:  # the branch ends the path, so its slash stays unquoted
            path = f"{self._pulls}/{quote(target, safe='')}/{quote(branch, safe='/')}"
            return self._read(self._call("GET", path))
        except ForgeError as error:
            if error.status == 404:  # or the token may not see the project
                return None
            raise


def forge_for(proposals: Proposals, token_file: Path | None) -> Forge | None:
    if proposals.forge not in ("github", "gitea") or proposals.url is None:
        return None
    if token_file is None:
        raise ForgeError(
            f"proposals.forge is {proposals.forge}, but there is no token for it; set "
            "DEMANDOPS_FORGE_TOKEN_FILE to a file that holds the token, then start the generator "
            "again"
        )
    try:
        # read at each call, so that a person can replace the token while the generator runs
        token = read_secret(token_file).decode("latin-1").strip()
    except InvalidInput as error:
        raise ForgeError(f"the token file {error}") from None
    if not token.isascii() or not token.isprintable():
        raise ForgeError(f"the token file {token_file} must hold a token: one line of plain text")
    owner, name = proposals.project
    if proposals.forge == "gitea":
        root = proposals.url.strip("/").rsplit("/", 2)[0]
        return Gitea(proposals.api or f"{root}/api/v1", token, owner, name)
    scheme, host, *_ = urlsplit(proposals.url)
    public = "https://api.github.com" if host == "github.com" else f"{scheme}://{host}/api/v3"
    return GitHub(proposals.api or public, token, owner, name)
