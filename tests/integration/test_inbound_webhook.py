"""Real HTTP calls on loopback to the inbound webhook."""

from __future__ import annotations

import hashlib
import hmac
import http.client
import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from urllib.parse import urlsplit

import pytest
from demandops.base.errors import InvalidInput
from demandops.serve import http_server
from demandops.serve.http_server import PushWebhook

from tests.kit.limits import LONGEST_TEST_S, PATIENCE_S

SECRET = b"s3cret-of-the-hook"
BODY = b'{"ref": "refs/heads/main"}'


class Heard:
    """Counts the pushes that the webhook reports."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> None:
        self.times += 1


@pytest.fixture
def heard() -> Heard:
    return Heard()


@pytest.fixture
def signed(heard: Heard) -> Iterator[PushWebhook]:
    hook = PushWebhook("127.0.0.1:0", SECRET, heard)
    yield hook
    hook.close()


@pytest.fixture
def impatient(heard: Heard, monkeypatch: pytest.MonkeyPatch) -> Iterator[PushWebhook]:
    monkeypatch.setattr(http_server, "_STUCK_S", 0.5)  # set before any connection
    hook = PushWebhook("127.0.0.1:0", SECRET, heard)
    yield hook
    hook.close()


@pytest.fixture
def patient(heard: Heard, monkeypatch: pytest.MonkeyPatch) -> Iterator[PushWebhook]:
    """A webhook that cuts off no connection for being slow."""
    monkeypatch.setattr(http_server, "_STUCK_S", 2 * LONGEST_TEST_S)
    hook = PushWebhook("127.0.0.1:0", SECRET, heard)
    yield hook
    hook.close()


@pytest.fixture
def unsigned(heard: Heard) -> Iterator[PushWebhook]:
    hook = PushWebhook("127.0.0.1:0", b"", heard)
    yield hook
    hook.close()


def send(
    hook: PushWebhook,
    headers: dict[str, str] | None = None,
    *,
    method: str = "POST",
    path: str = "/push",
    body: bytes | None = BODY,
) -> tuple[int, str]:
    connection = http.client.HTTPConnection(str(urlsplit(hook.url).netloc), timeout=PATIENCE_S)
    try:
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read().decode().strip()
    finally:
        connection.close()


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


@pytest.mark.parametrize("server", GENUINE)
def test_who_knows_the_secret_is_heard(signed: PushWebhook, heard: Heard, server: str) -> None:
    assert send(signed, GENUINE[server]) == (202, "fetching")
    assert heard.times == 1


@pytest.mark.parametrize("case", FORGED)
def test_who_does_not_is_refused_and_the_log_holds_nothing_of_it(
    signed: PushWebhook, heard: Heard, case: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    for _ in range(3):
        assert send(signed, FORGED[case]) == (403, "not signed with the secret")
    assert heard.times == 0
    warnings = [record for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == 1, "several refusals must give one warning"
    for text in (SECRET.decode(), *(value for value in FORGED[case].values() if value)):
        assert text not in caplog.text


def test_without_a_secret_whoever_is_on_this_machine_is_heard(
    unsigned: PushWebhook, heard: Heard
) -> None:
    assert send(unsigned) == (202, "fetching")
    assert send(unsigned, body=None, headers={"Content-Length": "0"})[0] == 202
    assert heard.times == 2


@pytest.mark.parametrize("header", ["Origin", "Sec-Fetch-Site"])
def test_what_another_site_makes_a_browser_send_is_refused(
    unsigned: PushWebhook, heard: Heard, header: str
) -> None:
    assert send(unsigned, {header: "null"})[0] == 403
    assert heard.times == 0


def test_what_else_is_asked_is_answered_and_does_nothing(signed: PushWebhook, heard: Heard) -> None:
    github = GENUINE["github"]
    assert send(signed, method="GET", path="/", body=None) == (200, "ok")
    assert send(signed, method="HEAD", path="/", body=None) == (200, "")
    assert send(signed, method="GET", path="/push", body=None)[0] == 405
    assert send(signed, method="GET", path="/admin", body=None) == (404, "Not Found")
    assert send(signed, github, path="/")[0] == 405
    for path in ("/push/", "//push", "/push/../push"):
        assert send(signed, github, path=path)[0] == 404
    assert send(signed, github, method="PUT")[0] == 405
    assert heard.times == 0


@pytest.mark.parametrize(
    ("length", "status"),
    [("26214401", 413), ("9" * 400, 400), ("-1", 400), ("many", 400), ("\u00b2", 400)],
)
def test_a_body_without_bounds_is_not_read(
    signed: PushWebhook, heard: Heard, length: str, status: int
) -> None:
    head = "POST /push HTTP/1.1\r\nHost: x\r\n"
    with _connected(signed) as raw:
        raw.sendall(f"{head}Content-Length: {length}\r\n\r\n".encode("latin-1"))
        assert raw.recv(100).split()[1] == str(status).encode()
    assert heard.times == 0


def test_a_body_of_unknown_length_is_read_up_to_the_bound(
    signed: PushWebhook, heard: Heard
) -> None:
    head = "POST /push HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n"
    size = f"{len(BODY):x}\r\n".encode()
    with _connected(signed) as raw:
        raw.sendall(f"{head}X-Gitea-Signature: {mac()}\r\n\r\n".encode())
        raw.sendall(size + BODY + b"\r\n0\r\n\r\n")
        assert raw.recv(100).split()[1] == b"202"
    with _connected(signed) as raw, suppress(ConnectionError):
        raw.sendall(f"{head}\r\n".encode())
        for _ in range(27):
            raw.sendall(b"100000\r\n" + b"x" * (1 << 20) + b"\r\n")
        assert raw.recv(100).split()[1] == b"413"
    assert heard.times == 1


def test_every_answer_ends_its_connection(signed: PushWebhook) -> None:
    with _connected(signed) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 3)
        answer = b""
        while part := raw.recv(1000):
            answer += part
    assert answer.count(b"HTTP/1.1") == 1
    assert b"connection: close" in answer.lower()


def test_who_sends_slowly_is_cut_off_and_keeps_nobody_out(
    impatient: PushWebhook, heard: Heard
) -> None:
    slow = [_connected(impatient) for _ in range(40)]
    for number, raw in enumerate(slow):
        with suppress(ConnectionError):  # the hook may have closed it already
            raw.sendall(b"POST /push HTTP/1.1\r\nHost: x\r\n\r\n"[: number % 30 + 1])
    for raw in slow:
        assert _is_cut_off(raw)
        raw.close()
    assert send(impatient, GENUINE["gitea"])[0] == 202
    assert heard.times == 1


def test_however_many_connections_wait_health_and_pushes_are_answered(
    signed: PushWebhook, heard: Heard
) -> None:
    """The oldest connection gives way, so those who hold connections open cannot fill the hook."""
    head = b"POST /push HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\n"
    held = [_connected(signed) for _ in range(100)]
    for number, raw in enumerate(held):
        with suppress(ConnectionError):  # the hook may have closed it already
            raw.sendall(head[: number + 1] if number % 2 else head)
    assert send(signed, method="GET", path="/", body=None) == (200, "ok")
    assert send(signed, GENUINE["gitea"])[0] == 202
    assert all(_is_cut_off(raw) for raw in held[:68])
    for raw in held:
        raw.close()


def test_of_many_that_connect_at_once_the_first_is_answered() -> None:
    began, ended = threading.Event(), threading.Event()

    def push() -> None:  # the server accepts nobody meanwhile
        began.set()
        ended.wait(PATIENCE_S)

    hook = PushWebhook("127.0.0.1:0", b"", push)
    with ExitStack() as stack:
        stack.callback(hook.close)
        pushing = stack.enter_context(closing(_connected(hook)))
        pushing.sendall(b"POST /push HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n")
        assert began.wait(PATIENCE_S)
        health = stack.enter_context(closing(_connected(hook)))
        health.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        for _ in range(100):
            silent = stack.enter_context(socket.socket())
            silent.setblocking(False)
            silent.connect_ex(health.getpeername())
        ended.set()
        assert health.recv(12) == b"HTTP/1.1 200"


def test_who_sends_a_body_in_tiny_chunks_is_cut_off(signed: PushWebhook) -> None:
    """The parser takes as long for a chunk of one byte as for one of many thousand."""
    with _connected(signed) as raw, suppress(ConnectionError):
        raw.sendall(b"POST /push HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n")
        raw.sendall(b"1\r\nx\r\n" * 100_000 + b"0\r\n\r\n")
        assert raw.recv(100) == b""


def test_a_close_waits_for_no_slow_sender(patient: PushWebhook) -> None:
    with _connected(patient) as raw:
        raw.sendall(b"POST /push HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\nx")
        patient.close()
    with pytest.raises(ConnectionError):
        _connected(patient)


def test_many_at_once_are_all_answered(unsigned: PushWebhook, heard: Heard) -> None:
    answers: list[int] = []
    threads = [threading.Thread(target=lambda: answers.append(send(unsigned)[0])) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert answers == [202] * 8


def _is_cut_off(raw: socket.socket) -> bool:
    try:
        return raw.recv(200) == b""
    except ConnectionResetError:
        return True


def _connected(hook: PushWebhook) -> socket.socket:
    parts = urlsplit(hook.url)
    return socket.create_connection((str(parts.hostname), int(parts.port or 0)), timeout=PATIENCE_S)


# # ---- the options at the start ----


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("8090", "'8090' is not an address to listen on; write one like 127.0.0.1:8090"),
        (":8090", "':8090' is not an address to listen on; write one like 127.0.0.1:8090"),
        ("localhost:http", "'localhost:http' is not an address to listen on; write one like "
         "127.0.0.1:8090"),
        ("127.0.0.1:65536", "'127.0.0.1:65536' is not an address to listen on; write one like "
         "127.0.0.1:8090"),
        ("::" + "1" * 5000, f"'::{'1' * 77}…' is not an address to listen on; write one like "
         "127.0.0.1:8090"),
        ("0.0.0.0:0", "'0.0.0.0:0' can be reached from other machines, so notifications must be "
         "signed; give --webhook-secret-file FILE, or listen on 127.0.0.1"),
        ("nowhere.invalid:0", "'nowhere.invalid:0': host 'nowhere.invalid' cannot be resolved; "
         "write an address of this machine"),
        ("192.0.2.1:0", "cannot listen on '192.0.2.1:0': Cannot assign requested address; "
         "write an address of this machine"),
    ],
)  # fmt: skip
def test_an_address_that_will_not_do_is_told(address: str, message: str) -> None:
    with pytest.raises(InvalidInput) as error:
        PushWebhook(address, b"", lambda: None)
    assert str(error.value) == f"--webhook: {message}"


def test_a_port_in_use_is_told(unsigned: PushWebhook) -> None:
    taken = urlsplit(unsigned.url).netloc
    with pytest.raises(InvalidInput, match=f"cannot listen on '{taken}': Address already"):
        PushWebhook(taken, b"", lambda: None)


def test_with_a_secret_others_may_be_listened_to(heard: Heard) -> None:
    hook = PushWebhook("0.0.0.0:0", SECRET, heard)
    hook.close()
