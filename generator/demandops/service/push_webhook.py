"""The inbound webhook: a Git server reports a push, and the generator fetches at once.

Notifications are untrusted. The server only checks whether the sender knows the secret, and it
bounds the size, the time and the number of open connections.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import logging
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from demandops.errors import InvalidInput, fault

log = logging.getLogger("demandops")

PATH = "/push"
_MAX_BODY = 25 << 20
"""GitHub sends no more than this; a body is hashed and not stored."""
_CHUNK = 1 << 16
_TIMEOUT_S = 10.0
_AT_ONCE = 16
_WARN_EVERY_S = 60.0

_SIGNATURES = ("X-Hub-Signature-256", "X-Gitea-Signature", "X-Forgejo-Signature")
_TOKEN = "X-Gitlab-Token"  # noqa: S105 - a header's name


def read_secret(path: Path) -> bytes:
    """Return the secret in a file, without surrounding white space.

    Raises:
        InvalidInput: if the file cannot be read or is empty.
    """
    try:
        secret = path.read_bytes().strip()
    except OSError as error:
        message = f"cannot be read: {error.strerror or error}; put the webhook's secret there"
        raise InvalidInput([fault("", message).within(str(path))]) from None
    if not secret:
        message = "is empty; put there the secret that the Git server signs with"
        raise InvalidInput([fault("", message).within(str(path))])
    return secret


class PushWebhook:
    """An HTTP server for notifications; it runs until :meth:`close`."""

    def __init__(self, address: str, secret: bytes, on_push: Callable[[], None]) -> None:
        """Start the server.

        Args:
            address: ``host:port``; port 0 picks a free port.
            secret: the key that signs notifications; empty: unsigned ones are accepted, which is
                allowed only on a loopback address.
            on_push: called for each notification, in a thread of its own; must return at once.

        Raises:
            InvalidInput: if it cannot or must not listen on the address.
        """
        host, port = _parsed(address)
        family, bound = _resolved(host, port, address)
        if not secret and not ipaddress.ip_address(bound[0].partition("%")[0]).is_loopback:
            raise _invalid(
                f"'{address}' can be reached from other machines, so notifications must be "
                "signed; give --webhook-secret-file FILE, or listen on 127.0.0.1"
            )
        try:
            self._server = _Server(family, bound, secret, on_push)
        except OSError as error:
            raise _invalid(
                f"'{address}' cannot be listened on: {error.strerror}; choose another port"
            ) from None
        name, number = self._server.server_address[:2]
        self.url = f"http://{f'[{name!s}]' if ':' in str(name) else name!s}:{number}{PATH}"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="demandops-webhook", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _invalid(message: str) -> InvalidInput:
    return InvalidInput([fault("--webhook", message)])


def _parsed(address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    if not colon or not host or not (port.isascii() and port.isdigit()) or int(port) > 0xFFFF:
        raise _invalid(f"'{address}' is not an address to listen on; write one like 127.0.0.1:8090")
    return host.removeprefix("[").removesuffix("]"), int(port)


def _resolved(host: str, port: int, address: str) -> tuple[socket.AddressFamily, Any]:
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        raise _invalid(
            f"'{address}': host '{host}' cannot be resolved; write an address of this machine"
        ) from None
    return addresses[0][0], addresses[0][4]


class _Server(ThreadingHTTPServer):
    """A server with a bounded number of connections and a time limit for each."""

    daemon_threads = True
    block_on_close = False

    def __init__(
        self,
        family: socket.AddressFamily,
        bound: Any,  # noqa: ANN401 - as socket has it
        secret: bytes,
        on_push: Callable[[], None],
    ) -> None:
        self.address_family = family
        self.secret, self.on_push = secret, on_push
        self._room = threading.BoundedSemaphore(_AT_ONCE)
        self._warned = float("-inf")
        super().__init__(bound, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Handle a connection in a thread of its own, or close it if there are too many."""
        if not self._room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Handle a connection and cut it off at the time limit: a sender may be very slow."""
        timer = threading.Timer(_TIMEOUT_S, _cut, (request,))
        timer.daemon = True
        timer.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            timer.cancel()
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Log a broken connection at debug level only."""
        log.debug("a connection of the webhook ended early", exc_info=True)

    def warn(self, text: str) -> None:
        """Log a warning at most once a minute, because anyone may send requests."""
        if time.monotonic() - self._warned > _WARN_EVERY_S:
            self._warned = time.monotonic()
            log.warning("%s", text)


def _cut(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class _Handler(BaseHTTPRequestHandler):
    """Handles one request; every answer closes the connection."""

    server: _Server
    server_version, sys_version = "demandops", ""
    timeout = _TIMEOUT_S

    def do_GET(self) -> None:
        """Answer ``/`` with ok, so that the server can be checked."""
        if self.path == "/":
            self._answer(200, "ok")
        elif self.path == PATH:
            self._answer(405, "notifications are sent by POST")
        else:
            self._answer(404, "not found")

    do_HEAD = do_GET

    def do_POST(self) -> None:
        """Check a notification and report the push."""
        if self.path != PATH:
            self._answer(404, f"notifications go to {PATH}")
            return
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            self._answer(411, "Content-Length is missing")
        elif len(length) > len(str(_MAX_BODY)) or int(length) > _MAX_BODY:
            self._answer(413, "the body is too long")
        elif not self._is_genuine(int(length)):
            self.server.warn(
                f"a notification from {self.client_address[0]} was not signed with the webhook's "
                "secret; is it the same here and at the Git server?"
            )
            self._answer(403, "not signed with the secret")
        else:
            self.server.on_push()
            self._answer(202, "fetching")

    def _is_genuine(self, length: int) -> bool:
        """Read the body and return whether its sender knows the secret."""
        digest = hmac.new(self.server.secret, digestmod=hashlib.sha256)
        while length > 0:
            chunk = self.rfile.read(min(length, _CHUNK))
            if not chunk:
                return False
            digest.update(chunk)
            length -= len(chunk)
        if not self.server.secret:
            return True
        signatures = [self.headers.get(name, "").removeprefix("sha256=") for name in _SIGNATURES]
        signed = [hmac.compare_digest(_bytes(s), digest.hexdigest().encode()) for s in signatures]
        token = hmac.compare_digest(_bytes(self.headers.get(_TOKEN, "")), self.server.secret)
        return any(signed) or token

    def _answer(self, status: int, text: str) -> None:
        body = f"{text}\n".encode()
        self.send_response(status)
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Do not log a request: its headers hold secrets, and anyone may write the path."""


def _bytes(text: str) -> bytes:
    return text.strip().encode("utf-8", "surrogateescape")
