"""Free loopback ports and readiness probes.

A probe returns None if its component is ready. Otherwise it returns the reason, which becomes part
of the error of a failed start.
"""

from __future__ import annotations

import http.client
import random
import socket
import ssl
import threading
from collections.abc import Callable
from pathlib import Path

LOOPBACK = "127.0.0.1"
Probe = Callable[[], "str | None"]

# Below the kernel's usual range for outgoing connections (32768 and up), because a client's
# connection could take a port of that range before the server binds the port.
_PORTS = range(20000, 32000)
_given: set[int] = set()
_lock = threading.Lock()


def free_port() -> int:
    """Return a free loopback port; this process returns each port only once."""
    with _lock:
        for port in random.sample(_PORTS, len(_PORTS)):
            if port not in _given and _bindable(port):
                _given.add(port)
                return port
    raise OSError(f"no free port on {LOOPBACK} between {_PORTS.start} and {_PORTS.stop}")


def url(port: int, scheme: str = "http") -> str:
    return f"{scheme}://{LOOPBACK}:{port}"


def answers(port: int, path: str, authority: Path | None = None) -> Probe:
    """Return a probe for a GET with status 200, by HTTPS if there is an authority's file."""
    context = ssl.create_default_context(cafile=str(authority)) if authority else None

    def probe() -> str | None:
        connection = (
            http.client.HTTPSConnection(LOOPBACK, port, timeout=5, context=context)
            if context
            else http.client.HTTPConnection(LOOPBACK, port, timeout=5)
        )
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            text = answer.read(2000).decode(errors="replace").strip()
        except (OSError, http.client.HTTPException) as error:
            return f"{LOOPBACK}:{port}{path}: {error}"
        finally:
            connection.close()
        return None if answer.status == 200 else f"{path} answers {answer.status}: {text}"

    return probe


def accepts(port: int) -> Probe:
    def probe() -> str | None:
        try:
            socket.create_connection((LOOPBACK, port), timeout=5).close()
        except OSError as error:
            return f"{LOOPBACK}:{port}: {error}"
        return None

    return probe


def _bindable(port: int) -> bool:
    with socket.socket() as attempt:
        try:
            attempt.bind((LOOPBACK, port))
        except OSError:
            return False
    return True
