"""The page's site and its server."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import AsyncIterator, Callable
from datetime import timezone
from pathlib import Path
from typing import Any

import anyio
from anyio import to_thread
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from demandops import __version__
from demandops.base import settings
from demandops.base.errors import DemandOpsError, InvalidInput
from demandops.base.quoting import escaped, lines
from demandops.base.runtime import log
from demandops.model.config.base_model import parse_time, relative
from demandops.serve import http_server
from demandops.serve.http_server import HttpServer
from demandops.views.rows import TONES, exactly
from demandops.views.vocabulary import decision_text
from demandops.web.follower import Follower
from demandops.web.page_views import NAVIGATION, VIEWS, View, ViewRequest

# ---- the site ----
#
# No request changes anything, and no page loads anything from another host. Templates escape the
# HTML in every value that they print. They also escape invisible characters, except in the fields
# of the form, which send their values back.

_HERE = Path(__file__).parent
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
# HTTP headers that allow the inline scripts and styles of the documentation.
# This is safe, because the documentation contains no data of a state repo.
_DOCS_HEADERS = _HEADERS | {
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data:; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    )
}
_LOOK_S = 0.1
# Something is sent at least this often, so that no proxy takes a quiet stream for a dead one.
_HEARTBEAT_S = 15.0
# How long a browser waits before it opens a stream again that has ended.
_RETRY_MS = 1_000
_MOST_LISTENERS = 100  # half of the connections that the server accepts, so that others get in
# The parameters with which a view reads commits, which may take seconds.
_SLOW = {"at", "id", "name"}
# How many views may be rendered at the same time; slow ones may not delay the others.
_AT_ONCE, _SLOW_AT_ONCE = 20, 4
# How many requests may wait for a place; further ones are refused at once.
_MOST_WAITING = 20


class Site:
    def __init__(
        self, follower: Follower, hosts: tuple[str, ...] = ("*",), documentation: Path | None = None
    ) -> None:
        self._follower, self._has_docs = follower, documentation is not None
        self._quick = anyio.CapacityLimiter(_AT_ONCE)
        self._slow = anyio.CapacityLimiter(_SLOW_AT_ONCE)
        self._unanswered = Counter[anyio.CapacityLimiter]()
        self._templates = Environment(
            loader=FileSystemLoader(_HERE / "pages"),
            autoescape=True,
            undefined=StrictUndefined,
            # text with escapes for invisible characters; markup has been escaped already
            finalize=lambda value: value if isinstance(value, Markup) else lines(str(value)),
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self._templates.globals |= {"exactly": exactly, "tones": TONES, "program": __version__}
        self._templates.filters |= {
            "when": lambda at: escaped(f"{at.astimezone(timezone.utc):%Y-%m-%d %H:%M:%S UTC}"),
            # the date only if it is not today's
            "clock": lambda at, now: at.astimezone(timezone.utc).strftime(
                "%H:%M:%S UTC"
                if at.astimezone(timezone.utc).date() == now.astimezone(timezone.utc).date()
                else "%Y-%m-%d %H:%M UTC"
            ),
            "ago": relative,
            "iso": lambda at: f"{at.astimezone(timezone.utc):%Y-%m-%dT%H:%M:%SZ}",
            "moment": parse_time,
            "decision": decision_text,
            "sh": shlex.quote,
            # a line may end behind a slash of an id or a topic, and in no word
            "name": lambda text: escape(lines(str(text))).replace("/", Markup("/<wbr>")),
        }
        self.application = Starlette(
            routes=[
                *(Route(path, self._shows(view), methods=["GET"]) for path, view in VIEWS.items()),
                Route("/events", _Events(follower), methods=["GET"]),
                Route("/health", self._health, methods=["GET"]),
                Mount("/static", StaticFiles(directory=_HERE / "static")),
                *([Mount("/docs", StaticFiles(directory=documentation))] if documentation else []),
            ],
            middleware=[
                Middleware(_Closed),
                Middleware(TrustedHostMiddleware, allowed_hosts=list(hosts), www_redirect=False),
            ],
            exception_handlers={404: self._nothing_here},
        )
        # Starlette would redirect to an address with the Host header, which the client chooses.
        self.application.router.redirect_slashes = False

    def _shows(self, view: View) -> Callable[[Request], Any]:
        async def answer(request: Request) -> Response:
            limiter = self._slow if _SLOW & request.query_params.keys() else self._quick
            if self._unanswered[limiter] >= limiter.total_tokens + _MOST_WAITING:
                return PlainTextResponse("too many requests wait; try again later\n", 503)
            self._unanswered[limiter] += 1
            try:
                return await to_thread.run_sync(self._render, view, request, limiter=limiter)
            finally:
                self._unanswered[limiter] -= 1

        return answer

    def _render(self, view: View, request: Request) -> Response:
        try:
            version = self._follower.version  # before the data, so that no later change is missed
            with self._follower.reading():
                asked = ViewRequest(self._follower, request)
                template, data = view(asked)
                common = {
                    "navigation": NAVIGATION,
                    "here": asked,
                    "now": asked.source.now,
                    "source": asked.source,
                    "has_docs": self._has_docs,
                    "version": version,
                }
                return HTMLResponse(self._templates.get_template(template).render(common | data))
        except DemandOpsError as error:
            return self._message("Nothing to show", str(error), 404)
        except Exception:  # the visitor must learn where to look
            log.exception("view %s of the page does not work", request.url.path)
            text = "a fault of the program; see its log"
            return self._message("This view does not work", text, 500)

    def _message(self, title: str, text: str, status: int) -> Response:
        page = self._templates.get_template("message.html.j2")
        return HTMLResponse(page.render(title=title, text=text), status)

    async def _nothing_here(self, request: Request, error: Exception) -> Response:
        return self._message("Nothing here", "there is no such view or file", 404)

    async def _health(self, request: Request) -> Response:
        unread = self._follower.newest.unread
        return PlainTextResponse("behind\n" if unread else "ok\n", 503 if unread else 200)


class _Events:
    """Tells browsers by server-sent events which version the page's data has now."""

    def __init__(self, follower: Follower) -> None:
        self._follower, self._listeners = follower, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self._listeners >= _MOST_LISTENERS:
            await PlainTextResponse("too many pages are open\n", 503)(scope, receive, send)
            return
        unbuffered = {"X-Accel-Buffering": "no"}  # a proxy must pass on each event at once
        answer = StreamingResponse(self._changes(), 200, unbuffered, "text/event-stream")
        self._listeners += 1
        try:
            await answer(scope, receive, send)
        finally:
            self._listeners -= 1

    async def _changes(self) -> AsyncIterator[str]:
        told, silent = -1, 0.0
        yield f"retry: {_RETRY_MS}\n\n"
        while not self._follower.closed.is_set():
            version = self._follower.version
            if version != told:
                told, silent = version, 0.0
                yield f"event: change\ndata: {version}\n\n"
            elif silent > _HEARTBEAT_S:
                silent = 0.0
                yield ": still here\n\n"
            await anyio.sleep(_LOOK_S)
            silent += _LOOK_S


class _Closed:
    """Middleware that refuses what other sites make browsers ask, and adds headers to answers."""

    def __init__(self, application: ASGIApp) -> None:
        self._application = application

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                is_of_docs = scope["path"].startswith("/docs/")
                MutableHeaders(scope=message).update(_DOCS_HEADERS if is_of_docs else _HEADERS)
            await send(message)

        headers = Headers(scope=scope)
        site, origin = headers.get("sec-fetch-site"), headers.get("origin")
        if site is None:  # an old browser, a program, or another machine's page without TLS
            is_foreign = origin is not None and origin.partition("://")[2] != headers.get("host")
        else:
            # A link to the page may be on any site: the browser shows the page in a tab of its own,
            # where no other site can read it. `sec-purpose` says that nobody has followed the link
            # yet.
            is_link = (
                headers.get("sec-fetch-mode") == "navigate"
                and headers.get("sec-fetch-dest") == "document"
                and "sec-purpose" not in headers
            )
            is_foreign = site not in ("same-origin", "none") and not is_link
        refusal = PlainTextResponse("another site asked for this; open the page itself\n", 403)
        await (refusal if is_foreign else self._application)(scope, receive, sending)


# ---- the web server ----

# How many connections may be open; at most half of them are streams of events (`Site`).
_MOST_CONNECTIONS = 200


class WebServer:
    def __init__(self, address: str, option: str, follower: Follower) -> None:
        # The follower is closed by `close`, or if the server cannot listen. `option` is the option
        # that gave the address, for messages.
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
        # With any other name in the Host header, another site could read the page through the
        # browsers of its visitors (DNS rebinding). A server that others reach may have any name,
        # for example that of a reverse proxy.
        hosts = ("127.0.0.1", "localhost", "[::1]", "::1") if is_local else ("*",)
        site = Site(follower, hosts, settings.documentation())
        self._server = HttpServer(listening, site.application, "web", _MOST_CONNECTIONS)

    def close(self) -> None:
        self._follower.closed.set()  # ends the open streams of events
        self._server.close()
        self._follower.close()
