"""Real HTTP calls on loopback to the inbound webhook."""

from __future__ import annotations

import hashlib
import hmac
import http.client
import logging
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from urllib.parse import urlsplit

import pytest
from demandops.base.errors import InvalidInput
from demandops.serve import http_server
from demandops.serve.http_server import PushWebhook

from tests.kit import plain_yaml
from tests.kit.limits import LONGEST_TEST_S, PATIENCE_S

SECRET = b"s3cret-of-the-hook"
BODY = b'{"ref": "refs/heads/main"}'
ADDRESSES = plain_yaml.beside(__file__)
POST = b"POST /push HTTP/1.1\r\nHost: x\r\n"


@pytest.fixture
def heard() -> list[str]:
    """The pushes that the webhooks of `started` reported."""
    return []


@pytest.fixture
def signed(heard: list[str]) -> Iterator[PushWebhook]:
    with closing(PushWebhook("127.0.0.1:0", SECRET, lambda: heard.append("push"))) as hook:
        yield hook


@pytest.fixture
def unsigned(heard: list[str]) -> Iterator[PushWebhook]:
    with closing(PushWebhook("127.0.0.1:0", b"", lambda: heard.append("push"))) as hook:
        yield hook


def send(
    hook: PushWebhook,
    headers: dict[str, str] | None = None,
    *,
    method: str = "POST",
    path: str = "/push",
    body: bytes | None = BODY,
) -> tuple[int, str]:
    with closing(http.client.HTTPConnection(urlsplit(hook.url).netloc, timeout=PATIENCE_S)) as call:
        call.request(method, path, body, headers or {})
        answer = call.getresponse()
        return answer.status, answer.read().decode().strip()


def connected(hook: PushWebhook) -> socket.socket:
    parts = urlsplit(hook.url)
    return socket.create_connection((str(parts.hostname), int(parts.port or 0)), timeout=PATIENCE_S)


def mac(body: bytes = BODY, secret: bytes = SECRET) -> str:
    return hmac.new(secret, body, hashlib.sha256).hexdigest()


GENUINE = {
    "github": {"X-Hub-Signature-256": f"sha256={mac()}", "X-GitHub-Event": "push"},
    "gitea": {"X-Gitea-Signature": mac()},
    "forgejo": {"X-Forgejo-Signature": mac(), "X-Gitea-Signature": mac()},
    "gitlab": {"X-Gitlab-Token": SECRET.decode(), "X-Gitlab-Event": "Push Hook"},
}
FORGED = {
    "nothing": {},
    "another-secret": {"X-Hub-Signature-256": f"sha256={mac(secret=b'guess')}"},
    "another-body": {"X-Hub-Signature-256": f"sha256={mac(b'{}')}"},
    "no-secret": {"X-Hub-Signature-256": f"sha256={mac(secret=b'')}"},
    "sha1": {"X-Hub-Signature": f"sha1={hmac.new(SECRET, BODY, hashlib.sha1).hexdigest()}"},
    "empty": {"X-Hub-Signature-256": "", "X-Gitea-Signature": "", "X-Gitlab-Token": ""},
    "cut-off": {"X-Gitea-Signature": mac()[:-1]},
    "token": {"X-Gitlab-Token": SECRET.decode()[:-1]},
    "not-ascii": {"X-Gitlab-Token": "s\xe9cret", "X-Gitea-Signature": "\xe9" * 64},
}


@pytest.mark.parametrize("headers", GENUINE.values(), ids=GENUINE)
def test_who_knows_the_secret_is_heard(
    signed: PushWebhook, heard: list[str], headers: dict[str, str]
) -> None:
    assert send(signed, headers) == (202, "fetching")
    assert len(heard) == 1


@pytest.mark.parametrize("headers", FORGED.values(), ids=FORGED)
def test_who_does_not_is_refused_and_the_log_holds_nothing_of_it(
    signed: PushWebhook,
    heard: list[str],
    headers: dict[str, str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    for _ in range(3):
        assert send(signed, headers)[0] == 403
    assert heard == []
    warnings = [record for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == 1, "several refusals must give one warning"
    for text in (SECRET.decode(), *filter(None, headers.values())):
        assert text not in caplog.text


def test_without_a_secret_whoever_is_on_this_machine_is_heard_but_no_browser(
    unsigned: PushWebhook, heard: list[str]
) -> None:
    assert send(unsigned, body=None, headers={"Content-Length": "0"})[0] == 202
    with ThreadPoolExecutor(8) as pool:  # many at once
        answers = [*pool.map(lambda _: send(unsigned), range(8))]
    assert answers == [(202, "fetching")] * 8
    assert {send(unsigned, {name: "null"})[0] for name in ("Origin", "Sec-Fetch-Site")} == {403}
    assert len(heard) == 9


def test_what_else_is_asked_is_answered_and_does_nothing(
    signed: PushWebhook, heard: list[str]
) -> None:
    github = GENUINE["github"]
    assert send(signed, method="GET", path="/", body=None) == (200, "ok")
    assert send(signed, method="HEAD", path="/", body=None) == (200, "")
    assert send(signed, method="GET", path="/push", body=None)[0] == 405
    assert send(signed, method="GET", path="/admin", body=None)[0] == 404
    assert send(signed, github, path="/")[0] == 405
    for path in ("/push/", "//push", "/push/../push"):
        assert send(signed, github, path=path)[0] == 404
    assert send(signed, github, method="PUT")[0] == 405
    assert heard == []
    with connected(signed) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 3)
        answer = b"".join(iter(lambda: raw.recv(1000), b""))
    assert answer.count(b"HTTP/1.1") == 1, "every answer must end its connection"
    assert b"connection: close" in answer.lower()


@pytest.mark.parametrize(
    ("length", "status"),
    [("26214401", 413), ("9" * 400, 400), ("-1", 400), ("many", 400), ("\u00b2", 400)],
)
def test_a_body_without_bounds_is_not_read(
    signed: PushWebhook, heard: list[str], length: str, status: int
) -> None:
    with connected(signed) as raw:
        raw.sendall(POST + f"Content-Length: {length}\r\n\r\n".encode("latin-1"))
        assert raw.recv(100).split()[1] == str(status).encode()
    assert heard == []


CHUNKED = POST + b"Transfer-Encoding: chunked\r\n"


def test_a_body_of_unknown_length_is_read_up_to_the_bound(
    signed: PushWebhook, heard: list[str]
) -> None:
    size = f"{len(BODY):x}\r\n".encode()
    with connected(signed) as raw:
        raw.sendall(CHUNKED + f"X-Gitea-Signature: {mac()}\r\n\r\n".encode())
        raw.sendall(size + BODY + b"\r\n0\r\n\r\n")
        assert raw.recv(100).split()[1] == b"202"
    with connected(signed) as raw, suppress(ConnectionError):
        raw.sendall(CHUNKED + b"\r\n")
        for _ in range(27):
            raw.sendall(b"100000\r\n" + b"x" * (1 << 20) + b"\r\n")
        assert raw.recv(100).split()[1] == b"413"
    assert len(heard) == 1


def test_who_sends_a_body_in_tiny_chunks_is_cut_off(signed: PushWebhook) -> None:
    """The parser takes as long for a chunk of one byte as for one of many thousand."""
    with connected(signed) as raw, suppress(ConnectionError):
        raw.sendall(CHUNKED + b"\r\n")
        raw.sendall(b"1\r\nx\r\n" * 100_000 + b"0\r\n\r\n")
        assert raw.recv(100) == b""


def test_of_many_that_connect_at_once_the_first_is_answered() -> None:
    began, ended = threading.Event(), threading.Event()

    def push() -> None:  # the server accepts nobody meanwhile
        began.set()
        ended.wait(PATIENCE_S)

    hook = PushWebhook("127.0.0.1:0", b"", push)
    with ExitStack() as stack:
        stack.callback(hook.close)
        pushing = stack.enter_context(closing(connected(hook)))
        pushing.sendall(POST + b"Content-Length: 0\r\n\r\n")
        assert began.wait(PATIENCE_S)
        health = stack.enter_context(closing(connected(hook)))
        health.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        for _ in range(100):
            silent = stack.enter_context(socket.socket())
            silent.setblocking(False)
            silent.connect_ex(health.getpeername())
        ended.set()
        assert health.recv(12) == b"HTTP/1.1 200"


def test_a_close_waits_for_no_slow_sender(
    signed: PushWebhook, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http_server, "_STUCK_S", 2 * LONGEST_TEST_S)
    with connected(signed) as raw:
        raw.sendall(POST + b"Content-Length: 100\r\n\r\nx")
        signed.close()
    with pytest.raises(ConnectionError):
        connected(signed)


# ---- the options at the start ----


@pytest.mark.parametrize(("address", "told"), ADDRESSES)
def test_an_address_that_will_not_do_is_told(
    unsigned: PushWebhook, address: str, told: str
) -> None:
    taken = urlsplit(unsigned.url).netloc
    with pytest.raises(InvalidInput) as error:
        PushWebhook(address or taken, b"", lambda: None)
    assert str(error.value).startswith(f"--webhook: {told.replace('TAKEN', taken)}")
    PushWebhook("0.0.0.0:0", SECRET, lambda: None).close()  # for signed notifications
