"""A smart-HTTP Git server over `git http-backend`, for the state repo.

The server runs as its own process (`python githttp.py --root DIR --port N`), so that tests can kill
or pause it like any other part of the rig. It needs only Python and Git. A push to a repository
that does not exist creates the repository. If the server's environment has GIT_HTTP_USER and
GIT_HTTP_PASSWORD, the server requires that user and password by basic authentication.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import hmac
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path, PurePosixPath
from urllib.parse import parse_qs, unquote

USER_VARIABLE = "GIT_HTTP_USER"
PASSWORD_VARIABLE = "GIT_HTTP_PASSWORD"  # noqa: S105 - a variable's name
HEALTH = "/-/healthz"
_CHUNK = 64 * 1024

# These settings replace the host's. A garbage collection in the background would race with the next
# push.
_CONFIGURATION = {
    "core.fsync": "none",
    "gc.auto": "0",
    "http.receivepack": "true",
    "receive.autogc": "false",
    "safe.directory": "*",
    "uploadpack.allowAnySHA1InWant": "true",
    "uploadpack.allowFilter": "true",
}


class GitServer(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128

    def __init__(self, root: Path, port: int, handler: type[Handler]) -> None:
        super().__init__(("127.0.0.1", port), handler)
        self.root = root.resolve()
        user, password = os.environ.get(USER_VARIABLE), os.environ.get(PASSWORD_VARIABLE)
        self.expected = ""
        if user and password:
            self.expected = "Basic " + base64.b64encode(f"{user}:{password}".encode()).decode()
        self.environment = {
            "PATH": os.environ.get("PATH", os.defpath),
            "HOME": str(self.root),
            "GIT_CONFIG_NOSYSTEM": "1",
            "GIT_CONFIG_GLOBAL": os.devnull,
            "GIT_HTTP_EXPORT_ALL": "1",
            "GIT_PROJECT_ROOT": str(self.root),
            "GIT_CONFIG_COUNT": str(len(_CONFIGURATION)),
        }
        for number, (key, value) in enumerate(_CONFIGURATION.items()):
            setting = {f"GIT_CONFIG_KEY_{number}": key, f"GIT_CONFIG_VALUE_{number}": value}
            self.environment |= setting

    def git(self, *arguments: str, sent: bytes = b"", **variables: str) -> bytes:
        command = ["git", *arguments]
        environment = self.environment | variables
        done = subprocess.run(
            command, env=environment, input=sent, stdout=subprocess.PIPE, check=False
        )
        return bytes(done.stdout)


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"  # with 1.0 a client that sends "Expect: 100-continue" would wait
    server: GitServer

    def serve(self) -> None:
        self.close_connection = True  # this tells the client where the answer ends
        path, _, query = self.path.partition("?")
        path = unquote(path)
        given = self.headers.get("Authorization", "").encode()
        expected = self.server.expected.encode()
        if path == HEALTH:
            self._answer(HTTPStatus.OK, "serving")
        elif expected and not hmac.compare_digest(given, expected):
            self._answer(HTTPStatus.UNAUTHORIZED, "give a user and a password")
        elif ".." in PurePosixPath(path).parts:
            self._answer(HTTPStatus.BAD_REQUEST, "the path contains '..'; remove it")
        else:
            name = path.removesuffix("/info/refs")
            pushing = parse_qs(query).get("service") == ["git-receive-pack"]
            repository = self.server.root / name.strip("/")
            if name != path and pushing and name.endswith(".git") and not repository.exists():
                options = ("--quiet", "--bare", "--initial-branch=main")
                self.server.git("init", *options, str(repository))
            self.run_backend(path, query)

    do_GET = do_POST = serve

    def _answer(self, status: HTTPStatus, text: str) -> None:
        body = f"{text}\n".encode()
        self.send_response(status)
        if status is HTTPStatus.UNAUTHORIZED:
            self.send_header("WWW-Authenticate", 'Basic realm="rig"')
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def run_backend(self, path: str, query: str) -> None:
        try:
            sent = b"".join(self.body())
        except (OSError, ValueError) as error:
            self.log_error("request body: %s", error)
            return
        variables = {
            "REQUEST_METHOD": self.command,
            "PATH_INFO": path,
            "QUERY_STRING": query,
            "REMOTE_ADDR": str(self.client_address[0]),
            "SERVER_PROTOCOL": self.request_version,
            "CONTENT_TYPE": self.headers.get("Content-Type", ""),
            "HTTP_CONTENT_ENCODING": self.headers.get("Content-Encoding", ""),
            "GIT_PROTOCOL": self.headers.get("Git-Protocol", ""),
            "CONTENT_LENGTH": self.headers.get("Content-Length", ""),
        }
        given = {name: value for name, value in variables.items() if value}
        answer = self.server.git("http-backend", sent=sent, **given)
        with contextlib.suppress(OSError):  # the client may have gone
            self._relay(answer)

    def body(self) -> Iterator[bytes]:
        if "chunked" in self.headers.get("Transfer-Encoding", "").lower():  # packs above 1 MB
            while size := int(self.rfile.readline().split(b";")[0], 16):
                yield from self._read(size)
                self.rfile.readline()
            while self.rfile.readline().strip():
                pass  # trailers
        else:
            yield from self._read(int(self.headers.get("Content-Length") or 0))

    def _read(self, left: int) -> Iterator[bytes]:
        while left > 0:
            chunk = self.rfile.read(min(left, _CHUNK))
            if not chunk:
                raise ValueError(f"the connection ended {left} bytes early")
            left -= len(chunk)
            yield chunk

    def _relay(self, answer: bytes) -> None:
        head, _, body = answer.partition(b"\r\n\r\n")
        if not head:
            self._answer(HTTPStatus.BAD_GATEWAY, "git http-backend sent no answer; see the log")
            return
        headers = dict(line.split(": ", 1) for line in head.decode("latin-1").splitlines())
        self.send_response(int(headers.pop("Status", "200").split()[0]))
        for name, value in {**headers, "Connection": "close"}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)


def _main() -> None:
    parser = argparse.ArgumentParser(description="serve the Git repositories below a folder")
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--port", type=int, required=True)
    options = parser.parse_args()
    options.root.mkdir(parents=True, exist_ok=True)
    server = GitServer(options.root, options.port, Handler)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    server.serve_forever(poll_interval=0.2)


if __name__ == "__main__":
    _main()
