"""The web server of the page, which has its own thread and its own address."""

from __future__ import annotations

import logging

from demandops import settings
from demandops.errors import InvalidInput
from demandops.service import http_server
from demandops.service.http_server import HttpServer
from demandops.web.follower import Follower
from demandops.web.site import Site

log = logging.getLogger("demandops")

# How many connections may be open; at most half of them are streams of events (`Site`).
_AT_ONCE = 200
_LOCAL_HOSTS = ("127.0.0.1", "localhost", "[::1]", "::1")


class WebServer:
    def __init__(self, address: str, option: str, follower: Follower) -> None:
        """Start the server.

        Args:
            address: ``host:port``; port 0 picks a free port.
            option: the option that gave the address, for messages.
            follower: closed by :meth:`close`, or if the server cannot listen.
        """
        self._follower = follower
        try:
            listening = http_server.bound(address, option)
        except InvalidInput:
            follower.close()
            raise
        self.url = f"{http_server.url_of(listening)}/"
        is_local = http_server.is_local(listening)
        if not is_local:
            log.warning(
                "everybody who reaches %s can read the page; a reverse proxy can ask for passwords "
                "(docs/page.md)",
                self.url,
            )
        # Other names would allow DNS rebinding, see `Site`. A server that others reach may have any
        # name, for example that of a reverse proxy.
        hosts = _LOCAL_HOSTS if is_local else ("*",)
        site = Site(follower, hosts, settings.documentation())
        self._server = HttpServer(listening, site.application, "web", _AT_ONCE)

    def close(self) -> None:
        self._follower.closed.set()  # ends the open streams of events
        self._server.close()
        self._follower.close()
