"""The page's server with many, silent or slow clients."""

from __future__ import annotations

import select
import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from urllib.parse import urlencode, urlsplit

import pytest
from demandops.repo.reader import Reader
from demandops.serve import http_server
from demandops.web import server
from demandops.web.follower import Follower
from demandops.web.server import WebServer

from tests.integration.web.conftest import Shown
from tests.kit.limits import LONGEST_TEST_S, PATIENCE_S
from tests.kit.rig import wait_until


@pytest.fixture
def follower(still: Shown) -> Follower:
    return Follower(Reader.of(str(still.bare)), {}, 0)


@pytest.fixture
def served(follower: Follower) -> Iterator[WebServer]:
    made = WebServer("127.0.0.1:0", "--listen", follower)
    yield made
    made.close()


@contextmanager
def asking(page: WebServer, text: str) -> Iterator[socket.socket]:
    """Connect a client that sends this text, unless it is cut off before, and reads nothing."""
    place = urlsplit(page.url)
    with socket.create_connection((place.hostname, place.port), PATIENCE_S) as made:
        with suppress(ConnectionError):
            made.sendall(text.replace("\n", "\r\n").encode())
        yield made


def status(page: WebServer, path: str = "") -> int:
    try:
        with urllib.request.urlopen(page.url + path, timeout=PATIENCE_S) as answer:  # noqa: S310
            code: int = answer.status
            return code
    except urllib.error.HTTPError as error:
        return error.code
    except OSError:  # a slow client was cut off before it asked
        return 0


STREAM = "GET /events HTTP/1.1\nHost: localhost\n\n"


def test_streams_of_events_are_bounded_and_end_with_the_server(
    follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_MOST_LISTENERS", 3)
    page = WebServer("127.0.0.1:0", "--listen", follower)
    with ExitStack() as stack:
        streams = [stack.enter_context(asking(page, STREAM)) for _ in range(3)]
        assert {one.recv(12) for one in streams} == {b"HTTP/1.1 200"}
        assert status(page, "events") == 503
        assert status(page) == 200
        streams[0].close()
        wait_until(lambda: _opened(page, stack), "there is room for another")
        page.close()
        for one in streams[1:]:
            while one.recv(4096):
                pass


def _opened(page: WebServer, stack: ExitStack) -> list[socket.socket]:
    """Return a new stream of events, if the server does not refuse it."""
    stream = stack.enter_context(asking(page, STREAM))
    with suppress(ConnectionError):
        return [stream] if stream.recv(12) == b"HTTP/1.1 200" else []
    return []


def is_cut_off(client: socket.socket) -> bool:
    try:
        return client.recv(200) == b""
    except ConnectionResetError:
        return True


def test_clients_that_neither_ask_nor_read_are_cut_off(
    follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http_server, "_STUCK_S", 0.2)
    monkeypatch.setattr(server, "_MOST_CONNECTIONS", 4)
    page = WebServer("127.0.0.1:0", "--listen", follower)
    for sent in ("", "GET / HTTP/1.1\nHost: loc"):
        with asking(page, sent) as client:
            assert is_cut_off(client)
    with ExitStack() as stack:
        for _ in range(4):
            stack.enter_context(asking(page, "GET /map HTTP/1.1\nHost: localhost\n\n" * 999))
        wait_until(lambda: status(page) == 200, "the page answers others")
    page.close()


def test_however_many_clients_hold_connections_open_health_is_told(
    served: WebServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest connection that waits for its client gives way, and no stream of events does."""
    monkeypatch.setattr(http_server, "_STUCK_S", 2 * LONGEST_TEST_S)
    with ExitStack() as stack:
        (stream,) = _opened(served, stack)
        held = [
            stack.enter_context(asking(served, "GET / HTTP/1.1\n"[: number % 15]))
            for number in range(250)
        ]
        assert status(served, "health") == 200
        assert all(is_cut_off(client) for client in held[:40])
        assert stream.recv(4096)


def test_a_stream_stays_open(follower: Follower, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_server, "_STUCK_S", 0.05)
    monkeypatch.setattr(server, "_HEARTBEAT_S", 0.3)
    page = WebServer("127.0.0.1:0", "--listen", follower)
    with ExitStack() as stack:
        streams, got = list[socket.socket](), b""
        wait_until(lambda: streams.extend(_opened(page, stack)) or streams, "a stream is open")
        while got.count(b": still here") < 3:
            chunk = streams[0].recv(4096)
            assert chunk, got
            got += chunk
    page.close()


def test_whatever_is_asked_of_git_the_page_refuses_and_lives(served: WebServer) -> None:
    for at in (":/", ":/(((.*)*)*)*!", "HEAD^{/.*}", "HEAD@{1}", "main^{tree}", "-x", "\0",
               "x" * 9000):  # fmt: skip
        assert status(served, f"services?{urlencode({'at': at})}") == 404
    assert status(served, "services?at=HEAD") == 200


def test_requests_for_earlier_commits_keep_no_other_request_waiting(
    served: WebServer, follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They wait for the loading lock. More of them than the server has threads are refused."""
    monkeypatch.setattr(server, "_MOST_WAITING", 3)
    request = "GET /?at=HEAD~1 HTTP/1.1\nHost: localhost\n\n"
    with ExitStack() as stack:
        stack.enter_context(follower._loading)
        waiting = [stack.enter_context(asking(served, request)) for _ in range(60)]
        ready, _, _ = select.select(waiting, [], [], PATIENCE_S)
        assert {each.recv(12) for each in ready} == {b"HTTP/1.1 503"}
        assert status(served, "health") == status(served) == 200
