"""The HTTP servers of the webhook and of the page, which no slow or busy client can fill.

Anyone who reaches the address may connect. A client that neither sends nor reads is cut off, and so
is one that sends in tiny pieces, because each piece costs as much as a large one. When too many
connections are open, the oldest that waits for its client gives way, so a health check gets in.
"""

from __future__ import annotations

import errno
import ipaddress
import re
import socket
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from demandops.errors import InvalidInput
from demandops.quoting import quoted
from demandops.runtime import REAL

_PORT = re.compile(r"[0-9]{1,5}")
_REMEDIES = {
    errno.EADDRNOTAVAIL: "write an address of this machine",
    errno.EACCES: "choose a port above 1023",
}

_STOP_TIMEOUT_S = 1
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
            timeout_graceful_shutdown=_STOP_TIMEOUT_S,
            headers=headers,
        )
        self._server = uvicorn.Server(config)
        self._thread = REAL.keep_running(name, lambda: self._server.run([listening]))

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join()


class _BoundedConnection(H11Protocol):
    """A connection that is closed if its client takes too long or sends in too small pieces.

    The client must complete a request within 10 to 20 seconds, and has as long to read each part of
    an answer. While the server computes an answer, no time counts. So a stream of events stays open
    while the client reads the events.
    """

    most: int  # of the connections that may be open

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401 - a type of asyncio
        super().connection_made(transport)
        self._since, self._bytes, self._pieces = self.loop.time(), 0, 0
        self._before: tuple[object, int] | None = None
        self._timer = self.loop.call_later(_STUCK_S, self._look)
        opened = [each for each in self.connections if isinstance(each, _BoundedConnection)]
        opened = [each for each in opened if not each.transport.is_closing()]
        if len(opened) > self.most:
            # not the new one, so that a health check gets in while others hold all connections
            waiting = [each for each in opened if each.waits_for_client()]  # this one too
            min(waiting, key=lambda each: each._since).transport.abort()

    def waits_for_client(self) -> bool:
        """Return whether the client has to send or to read before anything goes on."""
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
    """Return a socket that listens on ``host:port``; a fault of the address names the option."""
    host, colon, port = address.rpartition(":")
    if not colon or not host or not _PORT.fullmatch(port) or int(port) > 0xFFFF:
        raise InvalidInput.at(
            option,
            f"{quoted(address)} is not an address to listen on; write one like 127.0.0.1:8090",
        )
    host = host.removeprefix("[").removesuffix("]")  # of an IPv6 address
    try:
        family, *_, resolved = socket.getaddrinfo(
            host, int(port), type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError):
        raise InvalidInput.at(
            option,
            f"'{address}': host '{host}' cannot be resolved; write an address of this machine",
        ) from None
    listening = socket.socket(family)
    try:
        # a restart need not wait until the kernel has forgotten the last connections
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(resolved)
        listening.listen()
    except OSError as error:
        listening.close()
        remedy = _REMEDIES.get(error.errno or 0, "choose another port")
        raise InvalidInput.at(
            option, f"cannot listen on '{address}': {error.strerror}; {remedy}"
        ) from None
    return listening


def is_local(listening: socket.socket) -> bool:
    host = listening.getsockname()[0]
    return ipaddress.ip_address(host.partition("%")[0]).is_loopback


def url_of(listening: socket.socket) -> str:
    host, port = listening.getsockname()[:2]
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"
