"""The inbound webhook: a Git server reports a push, and the generator fetches at once.

Notifications are untrusted: their signature is checked, and their content is not read.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
from collections.abc import Callable

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from demandops.errors import InvalidInput
from demandops.runtime import REAL
from demandops.service import http_server
from demandops.service.http_server import HttpServer

log = logging.getLogger("demandops")

_PATH = "/push"
_AT_ONCE = 32
# The largest body that GitHub sends, in bytes; a body is hashed and not stored.
_MAX_BODY = 25 << 20
# Anyone may send requests, and a line for each could fill the log.
_WARN_EVERY_S = 60.0

_SIGNATURES = ("X-Hub-Signature-256", "X-Gitea-Signature", "X-Forgejo-Signature")
_TOKEN = "X-Gitlab-Token"  # noqa: S105 - a header's name


class PushWebhook:
    """The webhook's server, in a thread of its own; a request for ``/`` is a health check."""

    def __init__(self, address: str, secret: bytes, on_push: Callable[[], None]) -> None:
        """Start the server; port 0 picks a free port, and ``on_push`` must return at once.

        With an empty secret, notifications need no signature, and the address must be a loopback
        address.
        """
        self._secret, self._on_push = secret, on_push
        self._warned = float("-inf")
        listening = http_server.bound(address, "--webhook")
        if not (secret or http_server.is_local(listening)):
            listening.close()
            raise InvalidInput.at(
                "--webhook",
                f"'{address}' can be reached from other machines, so notifications must be "
                "signed; give --webhook-secret-file FILE, or listen on 127.0.0.1",
            )
        self.url = http_server.url_of(listening) + _PATH
        app = Starlette(routes=[Route("/", _health), Route(_PATH, self._handle, methods=["POST"])])
        app.router.redirect_slashes = False
        one_request = [("Connection", "close")]
        self._server = HttpServer(listening, app, "webhook", _AT_ONCE, one_request)

    def close(self) -> None:
        self._server.close()

    async def _handle(self, request: Request) -> PlainTextResponse:
        # a page in a person's browser can send requests to 127.0.0.1 too
        if "origin" in request.headers or "sec-fetch-site" in request.headers:
            return PlainTextResponse("a browser asked for this, not a Git server\n", 403)
        digest, length = hmac.new(self._secret, digestmod=hashlib.sha256), 0
        too_long = PlainTextResponse("the body is too long\n", 413)
        if int(request.headers.get("Content-Length", "0")) > _MAX_BODY:
            return too_long
        try:
            async for chunk in request.stream():
                length += len(chunk)
                if length > _MAX_BODY:
                    return too_long
                digest.update(chunk)
        except ClientDisconnect:
            return PlainTextResponse("the body is not complete\n", 400)
        if self._secret and not self._is_signed(request, digest.hexdigest()):
            if REAL.monotonic() - self._warned > _WARN_EVERY_S:
                self._warned = REAL.monotonic()
                log.warning(
                    "a notification from %s was not signed with the webhook's secret; is the "
                    "secret the same here and at the Git server?",
                    request.client.host if request.client else "",
                )
            return PlainTextResponse("not signed with the secret\n", 403)
        self._on_push()
        return PlainTextResponse("fetching\n", 202)

    def _is_signed(self, request: Request, digest: str) -> bool:
        # GitHub, Gitea and Forgejo sign the body; GitLab sends the secret itself
        signatures = [request.headers.get(name, "").removeprefix("sha256=") for name in _SIGNATURES]
        signed = [hmac.compare_digest(_bytes(s), digest.encode()) for s in signatures]
        token = hmac.compare_digest(_bytes(request.headers.get(_TOKEN, "")), self._secret)
        return any(signed) or token


async def _health(request: Request) -> PlainTextResponse:
    failures = REAL.failures  # answer only the names, because errors may quote secrets
    if failures:
        return PlainTextResponse(f"failing: {', '.join(failures)}\n", 503)
    return PlainTextResponse("ok\n")


def _bytes(text: str) -> bytes:
    return text.encode("latin-1").strip()
