"""HTTP served: the server that no client can fill, and the webhook that Git servers call."""

from __future__ import annotations

import errno
import hashlib
import hmac
import ipaddress
import re
import socket
from collections.abc import Callable
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse
from starlette.routing import Route
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from demandops.base.addresses import in_url
from demandops.base.errors import InvalidInput
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL, log

# ---- the server of the webhook and of the page ----
#
# Anyone who reaches the address may connect. A client that neither sends nor reads is cut off, and
# so is one that sends in tiny pieces, because each piece costs as much as a large one. When too
# many connections are open, the oldest that waits for its client gives way, so a health check gets
# in.

_PORT = re.compile(r"[0-9]{1,5}")
_REMEDIES = {
    errno.EADDRNOTAVAIL: "write an address of this machine",
    errno.EACCES: "choose a port above 1023",
}

_STUCK_S = 10.0
_PIECES = 2_000  # the most packets that one request may arrive in
_BYTES_IN_A_PIECE = 256


class HttpServer:
    def __init__(
        self,
        listening: socket.socket,
        application: ASGIApp,
        name: str,
        at_once: int,
        headers: list[tuple[str, str]] | None = None,
    ) -> None:
        """Start the server, with at most ``at_once`` connections; all answers have the headers."""

        class Connection(_BoundedConnection):
            most = at_once

        config = uvicorn.Config(
            application,
            http=Connection,
            # so many are accepted before any is read, so all must fit; more wait in the kernel
            backlog=at_once // 2,
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="error",  # anybody who connects could fill the log with warnings
            access_log=False,  # paths and headers may hold secrets
            proxy_headers=False,  # anyone may send such headers
            server_header=False,
            timeout_graceful_shutdown=1,
            headers=headers,
        )
        self._server = uvicorn.Server(config)
        self._thread = REAL.keep_running(name, lambda: self._server.run([listening]))

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join()


class _BoundedConnection(H11Protocol):
    # The client must complete a request within 10 to 20 seconds, and has as long to read each part
    # of an answer. While the server computes an answer, no time counts. So a stream of events stays
    # open while the client reads the events.

    most: int  # of the connections that may be open

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401 - a type of asyncio
        super().connection_made(transport)
        self._since, self._bytes, self._pieces = self.loop.time(), 0, 0
        self._before: tuple[object, int] | None = None
        self._timer = self.loop.call_later(_STUCK_S, self._look)
        opened = [peer for peer in self.connections if isinstance(peer, _BoundedConnection)]
        opened = [peer for peer in opened if not peer.transport.is_closing()]
        if len(opened) > self.most:
            # not the new one, so that a health check gets in while others hold all connections
            waiting = [peer for peer in opened if peer.waits_for_client()]  # this one too
            min(waiting, key=lambda peer: peer._since).transport.abort()

    def waits_for_client(self) -> bool:
        cycle = self.cycle
        is_asked = cycle is not None and not (cycle.response_complete or cycle.more_body)
        return not is_asked or self.flow.write_paused

    def data_received(self, data: bytes) -> None:
        # the parser takes as long for a packet, line or chunk of one byte as for a large one
        self._bytes += len(data)
        self._pieces += 1 + data.count(b"\r\n")
        if self._pieces > _PIECES + self._bytes // _BYTES_IN_A_PIECE:
            self.transport.abort()
        else:
            super().data_received(data)

    def on_response_complete(self) -> None:
        self._bytes = self._pieces = 0
        super().on_response_complete()

    def _look(self) -> None:
        # stuck is who has neither sent a request nor read a byte since the last look
        unread = self.transport.get_write_buffer_size()
        now = (self.cycle, unread) if self.waits_for_client() else None
        if now is not None and now == self._before:
            self.transport.abort()
            return
        self._before = now
        self._timer = self.loop.call_later(_STUCK_S, self._look)

    def connection_lost(self, exc: Exception | None) -> None:
        self._timer.cancel()
        super().connection_lost(exc)


def bound(address: str, option: str) -> socket.socket:
    host, colon, port = address.rpartition(":")
    if not colon or not host or not _PORT.fullmatch(port) or int(port) > 0xFFFF:
        message = f"{quoted(address)} is not an address to listen on; write one like 127.0.0.1:8090"
        raise InvalidInput.at(option, message)
    host = host.removeprefix("[").removesuffix("]")  # of an IPv6 address
    try:
        family, *_, resolved = socket.getaddrinfo(
            host, int(port), type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError):
        message = f"'{address}': host '{host}' cannot be resolved; write an address of this machine"
        raise InvalidInput.at(option, message) from None
    listening = socket.socket(family)
    try:
        # a restart need not wait until the kernel has forgotten the last connections
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(resolved)
        listening.listen()
    except OSError as error:
        listening.close()
        remedy = _REMEDIES.get(error.errno or 0, "choose another port")
        message = f"cannot listen on '{address}': {error.strerror}; {remedy}"
        raise InvalidInput.at(option, message) from None
    return listening


def is_local(listening: socket.socket) -> bool:
    host = listening.getsockname()[0]
    return ipaddress.ip_address(host.partition("%")[0]).is_loopback


def url_of(listening: socket.socket) -> str:
    host, port = listening.getsockname()[:2]
    return f"http://{in_url(host)}:{port}"


# ---- the inbound webhook: a Git server reports a push, and the generator fetches at once ----
#
# Notifications are untrusted: their signature is checked, and their content is not read.

_PATH = "/push"
# The largest body that GitHub sends, in bytes; a body is hashed and not stored.
_MAX_BODY = 25 << 20
_WARN_EVERY_S = 60.0  # anyone may send requests, and a line for each could fill the log

_SIGNATURES = ("X-Hub-Signature-256", "X-Gitea-Signature", "X-Forgejo-Signature")
_TOKEN = "X-Gitlab-Token"  # noqa: S105 - a header's name


class PushWebhook:
    """The webhook's server, in a thread of its own; a request for ``/`` is a health check."""

    def __init__(self, address: str, secret: bytes, on_push: Callable[[], None]) -> None:
        # ``on_push`` must return at once. Without a secret, notifications need no signature, and
        # the address must be a loopback address.
        self._secret, self._on_push = secret, on_push
        self._warned = float("-inf")
        listening = bound(address, "--webhook")
        if not (secret or is_local(listening)):
            listening.close()
            raise InvalidInput.at(
                "--webhook",
                f"'{address}' can be reached from other machines, so notifications must be "
                "signed; give --webhook-secret-file FILE, or listen on 127.0.0.1",
            )
        self.url = url_of(listening) + _PATH
        app = Starlette(routes=[Route("/", _health), Route(_PATH, self._handle, methods=["POST"])])
        app.router.redirect_slashes = False
        one_request = [("Connection", "close")]
        self._server = HttpServer(listening, app, "webhook", at_once=32, headers=one_request)

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
        # GitHub, Gitea and Forgejo sign the body; GitLab sends the secret itself
        given = [request.headers.get(name, "").removeprefix("sha256=") for name in _SIGNATURES]
        own = digest.hexdigest().encode()
        signed = [hmac.compare_digest(_bytes(signature), own) for signature in given]
        token = hmac.compare_digest(_bytes(request.headers.get(_TOKEN, "")), self._secret)
        if self._secret and not (any(signed) or token):
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


async def _health(request: Request) -> PlainTextResponse:
    failures = REAL.failures  # answer only the names, because errors may quote secrets
    if failures:
        return PlainTextResponse(f"failing: {', '.join(failures)}\n", 503)
    return PlainTextResponse("ok\n")


def _bytes(text: str) -> bytes:
    return text.encode("latin-1").strip()
