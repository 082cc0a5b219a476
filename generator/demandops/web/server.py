"""The web server of the page, which has its own thread and its own address."""

from __future__ import annotations

import asyncio
import logging

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from demandops import settings
from demandops.errors import InvalidInput
from demandops.runtime import REAL
from demandops.service import listening_socket
from demandops.web.follower import Follower
from demandops.web.site import Site

log = logging.getLogger("demandops")

_STOP_TIMEOUT_S = 1
_AT_ONCE = 200
_STUCK_S = 10.0
_LOCAL_HOSTS = ("127.0.0.1", "localhost", "[::1]", "::1")


class WebServer:
    """A running web server."""

    def __init__(self, address: str, option: str, follower: Follower) -> None:
        """Start the server.

        Args:
            address: ``host:port``; port 0 picks a free port.
            option: the option that gave the address, for messages.
            follower: provides what the page shows; closed by :meth:`close`, or if the server cannot
                listen.

        Raises:
            InvalidInput: if the server cannot listen on the address.
        """
        self._follower = follower
        try:
            self._socket = listening_socket.bound(address, option)
        except InvalidInput:
            follower.close()
            raise
        self.url = f"{listening_socket.url_of(self._socket)}/"
        is_local = listening_socket.is_local(self._socket)
        if not is_local:
            log.warning(
                "everybody who reaches %s can read the page; a reverse proxy can ask for passwords "
                "(docs/page.md)",
                self.url,
            )
        hosts = _LOCAL_HOSTS if is_local else ("*",)
        site = Site(follower, hosts, settings.documentation())
        config = uvicorn.Config(
            site.application,
            http=_BoundedConnection,
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="error",  # otherwise any client could fill the log with warnings
            access_log=False,
            proxy_headers=False,  # any client can send these headers
            server_header=False,
            limit_concurrency=_AT_ONCE,
            timeout_graceful_shutdown=_STOP_TIMEOUT_S,
        )
        self._server = uvicorn.Server(config)
        self._thread = REAL.keep_running("web", lambda: self._server.run([self._socket]))

    def close(self) -> None:
        """Stop the server and its follower."""
        self._follower.closed.set()  # ends the open streams of events
        self._server.should_exit = True
        self._thread.join()
        self._follower.close()


class _BoundedConnection(H11Protocol):
    """A connection that is closed if its client takes too long.

    The client must complete a request within 10 to 20 seconds. It has the same time to read each
    part of an answer. The time in which the server computes an answer does not count, so a stream
    of events stays open while the client reads the events.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._before: tuple[object, int] | None = None
        self._look_later()

    def _look_later(self) -> None:
        self._timer = self.loop.call_later(_STUCK_S, self._look)

    def _look(self) -> None:
        is_idle = self.cycle is None or self.cycle.response_complete
        unread = self.transport.get_write_buffer_size()
        now = (self.cycle, unread) if is_idle or self.flow.write_paused else None
        if now is not None and now == self._before:
            self.transport.abort()
            return
        self._before = now
        self._look_later()

    def connection_lost(self, exc: Exception | None) -> None:
        self._timer.cancel()
        super().connection_lost(exc)
