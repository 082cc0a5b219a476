"""A link between a cluster and the Git server; a test cuts it to simulate a lost radio link."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from urllib.parse import urlsplit, urlunsplit

from tests.e2e.rig.net import LOOPBACK, free_port

_CHUNK = 64 * 1024


class Relay:
    """Forwards connections to a URL's server; `pulls` counts the fetches through the relay."""

    def __init__(self, url: str) -> None:
        self._to = urlsplit(url)
        self._port = free_port()
        self._listener: socket.socket | None = None
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self.pulls = 0
        self.restore()

    @property
    def url(self) -> str:
        """The server's URL with the relay's address in place of the server's."""
        return urlunsplit(self._to._replace(netloc=f"{LOOPBACK}:{self._port}"))

    def restore(self) -> None:
        """Accept connections from now on."""
        listener = socket.create_server((LOOPBACK, self._port))
        self._listener = listener
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()

    def cut(self) -> None:
        """Refuse new connections and close the open ones."""
        if self._listener is not None:
            with contextlib.suppress(OSError):
                self._listener.shutdown(socket.SHUT_RDWR)  # the thread's accept() then returns
            self._listener.close()
            self._listener = None
        with self._lock:
            for end in self._open:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = listener.accept()
                far = socket.create_connection((self._to.hostname or "", self._to.port or 80))
                for source, target in ((near, far), (far, near)):
                    pump = threading.Thread(target=self._pump, args=(source, target), daemon=True)
                    pump.start()

    def _pump(self, source: socket.socket, target: socket.socket) -> None:
        with self._known(source), contextlib.suppress(OSError):
            while data := source.recv(_CHUNK):
                if data.startswith(b"POST ") and b"/git-upload-pack " in data:
                    self.pulls += 1
                target.sendall(data)
            target.shutdown(socket.SHUT_WR)

    @contextlib.contextmanager
    def _known(self, end: socket.socket) -> Iterator[None]:
        """List a socket as open during the block, so that `cut` closes it."""
        with self._lock:
            self._open.add(end)
        try:
            yield
        finally:
            with self._lock:
                self._open.discard(end)
