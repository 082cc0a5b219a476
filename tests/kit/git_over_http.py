"""The Git server of ``tests.e2e.rig`` inside a test's process, with faults that the test sets."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.e2e.rig import githttp
from tests.kit.http import running
from tests.kit.limits import LONGEST_TEST_S

_LOCK = threading.Lock()


@dataclass
class Faults:
    away: bool = False
    """Answer every request with 503."""
    pushes_to_refuse: int = 0
    """How many of the next pushes to refuse with ``status``."""
    status: int = 503
    largest_push: int = 1 << 40
    """Refuse larger pushes with 413, as a proxy in front of the server does."""
    page: bool = False
    """Answer every request with a page of HTML, as a login does."""
    cut_answers: int = 0
    """How many of the next pushes to carry out without an answer."""
    away_after_cut: bool = False
    hang: threading.Event | None = None
    """An event for which the server waits before it handles a request; None to wait for nothing."""
    hanging: bool = False
    cuts: Callable[[], bool] = lambda: False
    """Whether to cut the connection; asked before carrying out a request and before answering."""


@dataclass
class Server:
    url: str
    faults: Faults = field(default_factory=Faults)
    taken: int = 0
    """How many pushes the server carried out, with or without an answer."""
    refused: int = 0
    cut: int = 0


@contextmanager
def serving(root: Path, prefix: str = "") -> Iterator[Server]:
    server = Server("")

    class Serving(_Handler):
        ordered = server, prefix

    with running(githttp.GitServer(root, 0, Serving)) as url:
        server.url = f"{url}{prefix}"
        yield server


class _Handler(githttp.Handler):
    ordered: tuple[Server, str]

    def log_message(self, format: str, *args: object) -> None:
        """Do not log requests."""

    def serve(self) -> None:
        self.close_connection = True
        server, prefix = self.ordered
        faults = server.faults
        if faults.hang is not None:
            faults.hanging = True
            faults.hang.wait(LONGEST_TEST_S)
        self._received = b"".join(super().body())
        if self._cut(server):
            return
        path, _, query = self.path.removeprefix(prefix).partition("?")
        push = self.command == "POST" and path.endswith("/git-receive-pack")
        about_to = path.endswith("/info/refs") and query == "service=git-receive-pack"
        with _LOCK:
            no_push = bool((push or about_to) and faults.pushes_to_refuse and not faults.away)
            refuse = 503 if faults.away else faults.status if no_push else 0
            if push and len(self._received) > faults.largest_push:
                refuse = 413
            faults.pushes_to_refuse -= no_push
            server.refused += bool(refuse)
        if refuse:
            self.send_error(refuse)
            return
        if faults.page:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<html><title>Sign in</title></html>")
            return
        to_client, self.wfile = self.wfile, io.BytesIO()
        self.run_backend(path, query)
        answer, self.wfile = self.wfile.getvalue(), to_client
        # before a push, git sends only a flush ("0000") to ask whether it may push
        if push and len(self._received) > 4:
            with _LOCK:
                server.taken += 1
                cut = faults.cut_answers > 0
                faults.cut_answers -= cut
                faults.away = faults.away or (cut and faults.away_after_cut)
            if cut:
                self.connection.close()
                return
        if not self._cut(server):
            self.wfile.write(answer)

    do_GET = do_POST = serve

    def body(self) -> Iterator[bytes]:
        yield self._received

    def _cut(self, server: Server) -> bool:
        with _LOCK:
            cut = server.faults.cuts()
            server.cut += cut
        if cut:
            self.connection.close()
        return cut
