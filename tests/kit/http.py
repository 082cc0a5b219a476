"""HTTP servers on the loopback."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import chain
from pathlib import Path
from typing import Any

_CHUNKED = ("Transfer-Encoding", "chunked")


@dataclass(frozen=True)
class Call:
    method: str
    path: str
    headers: Message
    body: bytes

    def json(self) -> Any:
        return json.loads(self.body) if self.body else None


@dataclass(frozen=True)
class Answer:
    status: int = 200
    body: bytes | Iterable[bytes] = b""
    headers: dict[str, str] = field(default_factory=dict)

    @classmethod
    def json(cls, data: object, status: int = 200, **headers: str) -> Answer:
        return cls(
            status, json.dumps(data).encode(), {"Content-Type": "application/json"} | headers
        )


@dataclass
class Server:
    answer: Callable[[Call], Answer] = lambda call: Answer()
    url: str = ""
    calls: list[Call] = field(default_factory=list)

    @property
    def paths(self) -> list[str]:
        return [call.path for call in self.calls]


@contextmanager
def running(server: ThreadingHTTPServer) -> Iterator[str]:
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextmanager
def serving(answer: Callable[[Call], Answer] | None = None, port: int = 0) -> Iterator[Server]:
    """Run an HTTP server for the length of a block; it records and answers one call at a time."""
    served = Server() if answer is None else Server(answer)
    lock = threading.Lock()

    class Recorder(BaseHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """Do not log requests."""

        def _serve(self) -> None:
            length = int(self.headers.get("Content-Length") or 0)
            call = Call(self.command, self.path, self.headers, self.rfile.read(length))
            with lock:  # who sees the call may change what is answered to the next
                given = served.answer(call)
                served.calls.append(call)
            is_whole = isinstance(given.body, bytes)
            size = ("Content-Length", str(len(given.body))) if is_whole else _CHUNKED
            self.send_response(given.status)
            for name, value in (*given.headers.items(), size):
                self.send_header(name, value)
            self.end_headers()
            with suppress(OSError):
                if is_whole:
                    self.wfile.write(given.body)
                else:
                    for part in chain(given.body, [b""]):
                        self.wfile.write(b"%x\r\n%s\r\n" % (len(part), part))

        do_GET = do_POST = do_PUT = do_PATCH = do_DELETE = _serve

    with running(ThreadingHTTPServer(("127.0.0.1", port), Recorder)) as served.url:
        yield served


def kubeconfig(folder: Path, url: str) -> Path:
    config = {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": "c",
        "clusters": [{"name": "c", "cluster": {"server": url}}],
        "users": [{"name": "u", "user": {}}],
        "contexts": [{"name": "c", "context": {"cluster": "c", "user": "u"}}],
    }
    file = folder / "kubeconfig"
    file.write_text(json.dumps(config))
    return file
