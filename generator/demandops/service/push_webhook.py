"""The inbound webhook: a Git server reports a push, and the generator fetches at once.

Notifications are untrusted: their signature is checked, and their content is not read. Anyone who
reaches the address may connect. So the server limits the number of open connections, and cuts off
each connection after some seconds, however slow its sender is.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import logging
from collections.abc import Callable

import uvicorn
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from demandops.errors import InvalidInput
from demandops.runtime import REAL
from demandops.service import listening_socket

log = logging.getLogger("demandops")

_PATH = "/push"
_TIMEOUT_S = 10.0
_AT_ONCE = 16
_STOP_TIMEOUT_S = 1
_MAX_BODY = 25 << 20
"""The largest body that GitHub sends, in bytes; a body is hashed and not stored."""
_WARN_EVERY_S = 60.0

_SIGNATURES = ("X-Hub-Signature-256", "X-Gitea-Signature", "X-Forgejo-Signature")
_TOKEN = "X-Gitlab-Token"  # noqa: S105 - a header's name


class PushWebhook:
    """The webhook's server, in a thread of its own; a request for ``/`` is a health check."""

    def __init__(self, address: str, secret: bytes, on_push: Callable[[], None]) -> None:
        """Start the server.

        Args:
            address: ``host:port``; port 0 picks a free port.
            secret: the key that signs notifications. If it is empty, notifications need no
                signature, and the address must be a loopback address.
            on_push: called for each notification; must return at once.

        Raises:
            InvalidInput: the server cannot or must not listen on the address.
        """
        self._secret, self._on_push = secret, on_push
        self._warned = float("-inf")
        self._socket = listening_socket.bound(address, "--webhook")
        if not (secret or listening_socket.is_local(self._socket)):
            self._socket.close()
            raise InvalidInput.at(
                "--webhook",
                f"'{address}' can be reached from other machines, so notifications must be "
                "signed; give --webhook-secret-file FILE, or listen on 127.0.0.1",
            )
        self.url = listening_socket.url_of(self._socket) + _PATH
        app = Starlette(routes=[Route("/", _health), Route(_PATH, self._handle, methods=["POST"])])
        app.router.redirect_slashes = False
        config = uvicorn.Config(
            app,
            http=_BoundedConnection,
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="error",  # anybody who connects could fill the log with warnings
            access_log=False,  # paths and headers may hold secrets
            proxy_headers=False,  # anyone may send such headers
            server_header=False,
            headers=[("Connection", "close")],  # a connection has time for one request only
            timeout_graceful_shutdown=_STOP_TIMEOUT_S,
        )
        self._server = uvicorn.Server(config)
        self._thread = REAL.keep_running("webhook", lambda: self._server.run([self._socket]))

    def close(self) -> None:
        """Stop the server and wait for its end."""
        self._server.should_exit = True
        self._thread.join()

    async def _handle(self, request: Request) -> PlainTextResponse:
        """Answer a request; if it is a valid notification, report the push."""
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
            self._warn(request.client.host if request.client else "")
            return PlainTextResponse("not signed with the secret\n", 403)
        self._on_push()
        return PlainTextResponse("fetching\n", 202)

    def _is_signed(self, request: Request, digest: str) -> bool:
        signatures = [request.headers.get(name, "").removeprefix("sha256=") for name in _SIGNATURES]
        signed = [hmac.compare_digest(_bytes(s), digest.encode()) for s in signatures]
        token = hmac.compare_digest(_bytes(request.headers.get(_TOKEN, "")), self._secret)
        return any(signed) or token

    def _warn(self, sender: str) -> None:
        """Log, at most once a minute, that a notification is not signed.

        Anyone may send requests, and a line for each request could fill the log.
        """
        if REAL.monotonic() - self._warned > _WARN_EVERY_S:
            self._warned = REAL.monotonic()
            log.warning(
                "a notification from %s was not signed with the webhook's secret; is the secret "
                "the same here and at the Git server?",
                sender,
            )


class _BoundedConnection(H11Protocol):
    """A connection that the server cuts off after some seconds, or at once if too many are open."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        limit = _TIMEOUT_S if len(self.connections) <= _AT_ONCE else 0.0
        self._cut_off = asyncio.get_running_loop().call_later(limit, transport.abort)

    def connection_lost(self, exc: Exception | None) -> None:
        self._cut_off.cancel()
        super().connection_lost(exc)


async def _health(request: Request) -> PlainTextResponse:
    failures = REAL.failures  # answer only the names, because errors may quote secrets
    if failures:
        return PlainTextResponse(f"failing: {', '.join(failures)}\n", 503)
    return PlainTextResponse("ok\n")


def _bytes(text: str) -> bytes:
    return text.encode("latin-1").strip()
