"""Signed calls to a controller's webhook after a push.

Flux: a Receiver of type ``generic-hmac``, or ``generic`` without a secret. Argo CD: a push event in
GitHub's format, which Argo CD compares with the source of each Application.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from urllib.parse import quote, urlsplit

from demandops import http_call
from demandops.cluster.access import NoAccess
from demandops.http_call import NoAnswer
from demandops.settings import MAIN_BRANCH

_SCP = re.compile(r"(?:[^/@]+@)?(?P<host>[^/:@]+):(?P<path>.+)")
_NO_COMMIT = "0" * 40


@dataclass(frozen=True, slots=True)
class WebhookCall:
    """A request to a webhook; ``signature_header`` names the header for the body's signature."""

    body: bytes
    signature_header: str
    headers: dict[str, str] = field(default_factory=dict)


def flux_call() -> WebhookCall:
    """Return the call for a Receiver of Flux, which ignores the body."""
    return WebhookCall(b"{}", "X-Signature")


def argocd_call(repo: str, before: str, after: str, paths: Iterable[str] | None) -> WebhookCall:
    """Return the call for Argo CD: it reports that a repository's main branch moved.

    Args:
        repo: the URL from which Argo CD fetches the state repo.
        before: the commit of the last call; empty if there was none.
        after: the commit that was pushed.
        paths: the changed files; with ``None``, Argo CD refreshes all Applications of the repo.

    Raises:
        NoAccess: if the URL names no host, by which Argo CD identifies the repo.
    """
    event = {
        "ref": f"refs/heads/{MAIN_BRANCH}",
        "before": before or _NO_COMMIT,
        "after": after,
        "repository": {"html_url": web_address(repo), "default_branch": MAIN_BRANCH},
        "commits": [] if paths is None else [{"id": after, "modified": sorted(paths)}],
    }
    return WebhookCall(
        json.dumps(event).encode(), "X-Hub-Signature-256", {"X-GitHub-Event": "push"}
    )


def web_address(repo: str) -> str:
    """Return the address of a repository's web page, without user and password.

    Argo CD compares its host and path with those of each source's URL; it ignores scheme and port.

    Raises:
        NoAccess: if the URL names no host.
    """
    short = None if "://" in repo else _SCP.fullmatch(repo)
    if short:
        host, path = short["host"], quote(short["path"])
    else:
        parts = urlsplit(repo)
        host, path = parts.hostname or "", parts.path.removeprefix("/")
    if not host:
        raise NoAccess("the state repo's URL names no host")
    return f"https://{host}/{path.removesuffix('.git')}"


def signature(secret: bytes, body: bytes) -> str:
    """Return the HMAC of a body in the format of both controllers."""
    return f"sha256={hmac.new(secret, body, hashlib.sha256).hexdigest()}"


def send(url: str, call: WebhookCall, secret: bytes | None, timeout: float) -> None:
    """Send a call.

    Raises:
        NoAnswer: if the controller does not answer, rejects the call or redirects it.
    """
    headers = {"Content-Type": "application/json", **call.headers}
    if secret is not None:
        headers[call.signature_header] = signature(secret, call.body)
    answer = http_call.call("POST", url, headers, call.body, timeout)
    if not answer.is_success:
        raise NoAnswer(f"it answered {answer.status}")
