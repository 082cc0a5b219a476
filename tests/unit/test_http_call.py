"""HTTP calls to real servers on loopback: trust in certificates, time-outs, texts of errors."""

from __future__ import annotations

import logging
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import repeat
from pathlib import Path

import pytest
from demandops.base import http_call
from demandops.base.http_call import HttpAnswer, NoAnswer

from tests.kit import plain_yaml
from tests.kit.http import Answer, serving
from tests.kit.limits import PATIENCE_S

SECRET = "s3cret"  # noqa: S105 - no real secret


def call(url: str, timeout: float = PATIENCE_S) -> HttpAnswer:
    return http_call.call("POST", url, {"Authorization": SECRET}, b"{}", timeout)


@contextmanager
def speaking(
    *chunks: bytes, pause: float = 0.0, tls: ssl.SSLContext | None = None
) -> Iterator[str]:
    """Serve one connection: send the chunks with a pause after each, then close the connection."""

    def speak() -> None:
        try:
            connection, _ = listener.accept()
            with tls.wrap_socket(connection, server_side=True) if tls else connection as peer:
                request = b""
                while not request.endswith(b"{}"):
                    request += peer.recv(1 << 16) or b"{}"
                for chunk in chunks:
                    peer.sendall(chunk)
                    time.sleep(pause)
        except OSError:  # the caller has closed the connection
            pass

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=speak)
        thread.start()
        yield f"{'https' if tls else 'http'}://127.0.0.1:{listener.getsockname()[1]}/{SECRET}"
        thread.join()


def test_every_status_is_an_answer_and_nothing_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    with serving(lambda sent: Answer(418, b"no coffee")) as server:
        answer = call(f"{server.url}/{SECRET}")
    assert (answer.status, answer.body, answer.is_success) == (418, b"no coffee", False)
    assert server.calls[0].body == b"{}"
    assert SECRET not in caplog.text


HEAD = b"HTTP/1.1 200 OK\r\n\r\n"


def test_an_answer_without_end_is_cut_off() -> None:
    with (
        speaking(HEAD, *[b"x" * 1_000_000] * 5) as url,
        pytest.raises(NoAnswer, match="longer than 4000000 bytes; check the URL"),
    ):
        call(url)


def test_an_answer_that_drips_is_cut_off() -> None:
    late = r"no complete answer within 0\.3 s; check that the server"
    with (
        speaking(HEAD, *repeat(b"x", 10_000), pause=0.1) as url,
        pytest.raises(NoAnswer, match=late),
    ):
        call(url, timeout=0.3)
    chunks = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n", *[b"1\r\ny\r\n"] * 3
    with speaking(*chunks, b"0\r\n\r\n", pause=0.2) as url, pytest.raises(NoAnswer, match=late):
        call(url, timeout=0.3)


@pytest.mark.parametrize(("url", "proxy", "message"), plain_yaml.beside(__file__))
def test_an_error_tells_what_is_wrong_and_no_secret(
    monkeypatch: pytest.MonkeyPatch, url: str, proxy: str, message: str
) -> None:
    if proxy:
        monkeypatch.delenv("no_proxy")
        monkeypatch.setenv("ALL_PROXY", proxy)
    with pytest.raises(NoAnswer) as error:
        call(url)
    assert message in str(error.value)
    assert SECRET not in str(error.value)


def test_an_answer_that_is_not_http_is_not_quoted_because_it_may_echo_the_request() -> None:
    echo = f"POST /{SECRET} HTTP/1.1\r\nAuthorization: {SECRET}\r\n\r\n".encode()
    with speaking(echo) as url, pytest.raises(NoAnswer, match="is not HTTP, or not comp") as error:
        call(url)
    assert SECRET not in str(error.value)


def test_only_trusted_certificates_are_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "cert.pem"
    names = ["-subj", "/CN=x", "-addext", "subjectAltName=IP:127.0.0.1"]
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"]
    subprocess.run(
        [*command, "-nodes", "-keyout", str(key), "-out", str(certificate), *names],
        check=True,
        capture_output=True,
    )
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(certificate, key)
    answer = b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok"
    with speaking(answer, tls=tls) as url, pytest.raises(NoAnswer, match="set SSL_CERT_FILE to"):
        call(url)
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    with speaking(answer, tls=tls) as url:
        assert call(url).body == b"ok"
    unnamed = pytest.raises(NoAnswer, match="use a host that the certificate names")
    with speaking(answer, tls=tls) as url, unnamed:
        call(url.replace("127.0.0.1", "localhost"))
