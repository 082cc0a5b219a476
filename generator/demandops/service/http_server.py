"""The HTTP server: routes of one application, served by uvicorn in a thread of its own.

Anyone who reaches the address may connect. So the server limits the number of open connections, and
cuts each off after some seconds, even if its sender is very slow.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket
from collections.abc import Sequence
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.routing import BaseRoute, Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from demandops.errors import InvalidInput, fault
from demandops.runtime import REAL

_TIMEOUT_S = 10.0
_AT_ONCE = 16
_STOP_TIMEOUT_S = 1


class HttpServer:
    """A running server; it answers ``/`` with ok, for health checks, and serves its routes."""

    def __init__(self, address: str, routes: Sequence[BaseRoute], *, local_only: bool) -> None:
        """Start the server.

        Args:
            address: ``host:port``; port 0 picks a free port.
            routes: its routes in addition to ``/``.
            local_only: whether only this machine may reach it, because requests are not signed.

        Raises:
            InvalidInput: if it cannot or must not listen on the address.
        """
        self._socket = _listening(address, local_only)
        host, port = self._socket.getsockname()[:2]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        app = Starlette(routes=[Route("/", _health), *routes])
        app.router.redirect_slashes = False
        config = uvicorn.Config(
            app,
            http=_BoundedConnection,
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="error",  # whoever connects could fill the log with warnings
            access_log=False,  # paths and headers may hold secrets
            proxy_headers=False,  # anyone may write them
            server_header=False,
            headers=[("Connection", "close")],  # the time limit is for one request
            timeout_graceful_shutdown=_STOP_TIMEOUT_S,
        )
        self._server = uvicorn.Server(config)
        self._thread = REAL.start_thread("web", lambda: self._server.run([self._socket]))

    def close(self) -> None:
        """Stop the server and wait for its end."""
        self._server.should_exit = True
        self._thread.join()


class _BoundedConnection(H11Protocol):
    """A connection; the server refuses it if there are too many, and cuts it off in time."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        limit = _TIMEOUT_S if len(self.connections) <= _AT_ONCE else 0.0
        self._cut_off = asyncio.get_running_loop().call_later(limit, transport.abort)

    def connection_lost(self, exc: Exception | None) -> None:
        self._cut_off.cancel()
        super().connection_lost(exc)


async def _health(request: Request) -> PlainTextResponse:
    return PlainTextResponse("ok\n")


def _listening(address: str, local_only: bool) -> socket.socket:
    host, colon, port = address.rpartition(":")
    if not colon or not host or not (port.isascii() and port.isdigit()) or int(port) > 0xFFFF:
        raise _invalid(f"'{address}' is not an address to listen on; write one like 127.0.0.1:8090")
    host = host.removeprefix("[").removesuffix("]")
    family, bound = _resolved(host, int(port), address)
    if local_only and not ipaddress.ip_address(bound[0].partition("%")[0]).is_loopback:
        raise _invalid(
            f"'{address}' can be reached from other machines, so notifications must be "
            "signed; give --webhook-secret-file FILE, or listen on 127.0.0.1"
        )
    listener = socket.socket(family)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(bound)
        listener.listen()
    except OSError as error:
        listener.close()
        raise _invalid(
            f"'{address}' cannot be listened on: {error.strerror}; choose another port"
        ) from None
    return listener


def _resolved(host: str, port: int, address: str) -> tuple[socket.AddressFamily, Any]:
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        raise _invalid(
            f"'{address}': host '{host}' cannot be resolved; write an address of this machine"
        ) from None
    return addresses[0][0], addresses[0][4]


def _invalid(message: str) -> InvalidInput:
    return InvalidInput([fault("--webhook", message)])
