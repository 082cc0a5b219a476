"""What is sent to a controller's webhook after a push, and the signature that it goes by.

Flux: a Receiver of type `generic-hmac`, or `generic` where there is no secret. Argo CD: a push
event in GitHub's form, which it holds against the source of each of its Applications.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import re
import urllib.error
import urllib.request
from collections.abc import Iterable
from dataclasses import dataclass, field
from http.client import HTTPMessage
from typing import IO
from urllib.parse import quote, urlsplit

from demandops.cluster.access import NoAccess
from demandops.settings import MAIN_BRANCH

_SCP = re.compile(r"(?:[^/@]+@)?(?P<host>[^/:@]+):(?P<path>.+)")
_UNKNOWN = "0" * 40


@dataclass(frozen=True, slots=True)
class WebhookCall:
    """A request that is to be sent: which header carries the signature of ``body``."""

    body: bytes
    signature_header: str
    headers: dict[str, str] = field(default_factory=dict)


def flux_call() -> WebhookCall:
    """Return what a Receiver of Flux takes: the fact of the call is all that it says."""
    return WebhookCall(b"{}", "X-Signature")


def argocd_call(repo: str, before: str, after: str, paths: Iterable[str] | None) -> WebhookCall:
    """Return what Argo CD takes: that a repository's main branch moved.

    Args:
        repo: the URL by which Argo CD fetches the state repo.
        before: the commit that it was told of last; empty where there was none.
        after: the commit that was pushed.
        paths: what changed; None has every Application of the repo looked at.

    Raises:
        NoWay: where the URL names no host, for Argo CD could not tell the repo by it.
    """
    event = {
        "ref": f"refs/heads/{MAIN_BRANCH}",
        "before": before or _UNKNOWN,
        "after": after,
        "repository": {"html_url": web_address(repo), "default_branch": MAIN_BRANCH},
        "commits": [] if paths is None else [{"id": after, "modified": sorted(paths)}],
    }
    return WebhookCall(
        json.dumps(event).encode(), "X-Hub-Signature-256", {"X-GitHub-Event": "push"}
    )


def web_address(repo: str) -> str:
    """Return the web page that a forge would name for a repository, without user or password.

    Argo CD compares host and path of it with each source's URL, whatever the scheme and port.

    Raises:
        NoWay: where the URL names no host.
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
    """Return the HMAC of a body as both controllers take it."""
    return f"sha256={hmac.new(secret, body, hashlib.sha256).hexdigest()}"


def send(url: str, call: WebhookCall, secret: bytes | None, timeout: float) -> None:
    """Send a call.

    Raises:
        HTTPError: where it is not taken; a redirection is none, for it would lose the body.
        OSError: where nobody answers.
    """
    headers = {"Content-Type": "application/json", "User-Agent": "demandops", **call.headers}
    if secret is not None:
        headers[call.signature_header] = signature(secret, call.body)
    request = urllib.request.Request(url, data=call.body, headers=headers, method="POST")  # noqa: S310
    _OPENER.open(request, timeout=timeout).close()


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(
        self,
        req: urllib.request.Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: HTTPMessage,
        newurl: str,
    ) -> None:
        """Follow nothing."""


_OPENER = urllib.request.build_opener(_NoRedirect)
