"""A smart-HTTP Git server over `git http-backend`, with faults to order.

Threads of the test's own process, so that a test can say what goes wrong and see what came.
"""

from __future__ import annotations

import gzip
import os
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.kit.http import Handler, listening

_LOCK = threading.Lock()


@dataclass
class Faults:
    """What goes wrong, until it is told otherwise."""

    away: bool = False
    """Everything is answered with 503."""
    no_pushes: int = 0
    """So many pushes are answered with this status instead of being taken; see ``status``."""
    status: int = 503
    cut_answers: int = 0
    """So many pushes are taken and the connection is cut before the answer."""
    away_after_cut: bool = False
    """With the cut, the server goes away."""
    hang: threading.Event | None = None
    """Requests wait for this before anything is done."""
    cuts: Callable[[], bool] = lambda: False
    """Asked twice for each request: whether the connection is cut before it is carried out, and
    whether it is cut before the answer."""


@dataclass
class Server:
    """A running server: where it is, what is wrong with it, what came."""

    url: str
    faults: Faults = field(default_factory=Faults)
    taken: int = 0
    """Pushes that were carried out, whether or not the answer got through."""
    refused: int = 0
    """Requests answered with an error on order."""
    cut: int = 0
    """Connections cut at random."""


@contextmanager
def serving(root: Path, prefix: str = "") -> Iterator[Server]:
    """Serve the bare repositories below ``root`` at ``<url>/<name>``."""
    server = Server("")

    class Serving(_Handler):
        context = server, root, prefix

    with listening(Serving) as url:
        server.url = f"{url}{prefix}"
        yield server


class _Handler(Handler):
    context: tuple[Server, Path, str]
    protocol_version = "HTTP/1.1"

    def _serve(self) -> None:
        self.close_connection = True
        server, root, prefix = self.context
        faults = server.faults
        if faults.hang is not None:
            faults.hang.wait(60)
        body = self._body()
        if self._cut(server):
            return
        push = self.command == "POST" and self.path.endswith("/git-receive-pack")
        about_to = self.path.endswith("/info/refs?service=git-receive-pack")
        with _LOCK:
            no_push = bool((push or about_to) and faults.no_pushes and not faults.away)
            refuse = 503 if faults.away else faults.status if no_push else 0
            faults.no_pushes -= no_push
            server.refused += bool(refuse)
        if refuse:
            self.send_error(refuse)
            return
        answer = self._backend(root, self.path.removeprefix(prefix), body)
        # a push of nothing but a flush ("0000") is git asking whether it may
        if push and len(body) > 4:
            with _LOCK:
                server.taken += 1
                cut = faults.cut_answers > 0
                faults.cut_answers -= cut
                faults.away = faults.away or (cut and faults.away_after_cut)
            if cut:
                self.connection.close()
                return
        if not self._cut(server):
            self._relay(answer)

    do_GET = do_POST = _serve

    def _cut(self, server: Server) -> bool:
        with _LOCK:
            cut = server.faults.cuts()
            server.cut += cut
        if cut:
            self.connection.close()
        return cut

    def _body(self) -> bytes:
        body = b""
        if "chunked" in self.headers.get("Transfer-Encoding", ""):
            while size := int(self.rfile.readline().split(b";")[0], 16):
                body += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
        else:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        return gzip.decompress(body) if self.headers.get("Content-Encoding") == "gzip" else body

    def _backend(self, root: Path, target: str, body: bytes) -> bytes:
        path, _, query = target.partition("?")
        variables = {
            "GIT_PROJECT_ROOT": str(root),
            "GIT_HTTP_EXPORT_ALL": "1",
            "REQUEST_METHOD": self.command,
            "PATH_INFO": path,
            "QUERY_STRING": query,
            "CONTENT_TYPE": self.headers.get("Content-Type", ""),
            "CONTENT_LENGTH": str(len(body)),
            "GIT_PROTOCOL": self.headers.get("Git-Protocol", ""),
            "REMOTE_ADDR": "127.0.0.1",
        }
        command = ["git", "-c", "http.receivepack=true", "http-backend"]
        done = subprocess.run(
            command, input=body, env=os.environ | variables, capture_output=True, check=True
        )
        return done.stdout

    def _relay(self, answer: bytes) -> None:
        head, _, body = answer.partition(b"\r\n\r\n")
        status, headers = 200, []
        for line in head.decode("latin-1").split("\r\n"):
            name, _, value = line.partition(": ")
            if name == "Status":
                status = int(value.split()[0])
            else:
                headers.append((name, value))
        self.send_response(status)
        for name, value in headers:
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)
