"""Signed calls to a controller's webhook after a push.

A call to Flux goes to a Receiver of type ``generic-hmac``, or ``generic`` if there is no secret. A
call to Argo CD is a push event in GitHub's format. Argo CD compares the repository of the event
with the source of each Application.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import re
from collections.abc import Iterable
from urllib.parse import quote, urlsplit

from demandops import http_call
from demandops.cluster.clusters_file import NoAccess
from demandops.http_call import NoAnswer
from demandops.settings import MAIN_BRANCH

_TIMEOUT_S = 5.0
_SCP = re.compile(r"(?:[^/@]+@)?(?P<host>[^/:@]+):(?P<path>.+)")
_NO_COMMIT = "0" * 40


def call_flux(url: str, secret: bytes | None) -> None:
    # a Receiver ignores the body
    _send(url, b"{}", secret, "X-Signature", {})


def call_argocd(
    url: str, secret: bytes | None, repo: str, before: str, after: str, paths: Iterable[str] | None
) -> None:
    """Report to Argo CD that a repository's main branch moved, or raise NoAnswer.

    Argo CD fetches the state repo from ``repo``. ``before`` is the commit of the last call, if
    there was one. With None as ``paths``, Argo CD refreshes all Applications of the repo.
    """
    event = {
        "ref": f"refs/heads/{MAIN_BRANCH}",
        "before": before or _NO_COMMIT,
        "after": after,
        "repository": {"html_url": web_address(repo), "default_branch": MAIN_BRANCH},
        "commits": [] if paths is None else [{"id": after, "modified": sorted(paths)}],
    }
    body = json.dumps(event).encode()
    _send(url, body, secret, "X-Hub-Signature-256", {"X-GitHub-Event": "push"})


def web_address(repo: str) -> str:
    """Return the address of a repository's web page; NoAccess is raised if it names no host."""
    # Without user and password. Argo CD compares this address with each source's URL by host and
    # path, not by scheme and port.
    short = None if "://" in repo else _SCP.fullmatch(repo)
    if short:
        host, path = short["host"], quote(short["path"])
    else:
        parts = urlsplit(repo)
        host, path = parts.hostname or "", parts.path.removeprefix("/")
    if not host:
        raise NoAccess(
            "the state repo's URL names no host, but Argo CD needs a host to recognize the repo; "
            "write https://HOST/PATH or ssh://USER@HOST/PATH in demandops.yaml: argocd.url"
        )
    return f"https://{host}/{path.removesuffix('.git')}"


def signature(secret: bytes, body: bytes) -> str:
    """Return the HMAC of a body, in the format that Flux and Argo CD expect."""
    return f"sha256={hmac.new(secret, body, hashlib.sha256).hexdigest()}"


def _send(
    url: str, body: bytes, secret: bytes | None, signature_header: str, headers: dict[str, str]
) -> None:
    headers["Content-Type"] = "application/json"
    if secret is not None:
        headers[signature_header] = signature(secret, body)
    answer = http_call.call("POST", url, headers, body, _TIMEOUT_S)
    if not answer.is_success:
        raise NoAnswer(f"it answered {answer.status}")
