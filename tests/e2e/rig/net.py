"""Free loopback ports and readiness probes.

A probe returns None if its component is ready. Otherwise it returns the reason, which becomes part
of the error of a failed start.
"""

from __future__ import annotations

import random
import socket
import ssl
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import httpx

LOOPBACK = "127.0.0.1"
Probe = Callable[[], "str | None"]

# Below the kernel's usual range for outgoing connections (32768 and up), because a client's
# connection could take a port of that range before the server binds the port.
_PORTS = range(20000, 32000)
_given: set[int] = set()


def free_port() -> int:
    """Return a free loopback port; this process returns each port only once."""
    for port in random.sample(_PORTS, len(_PORTS)):
        if port not in _given:
            with socket.socket() as attempt, suppress(OSError):
                attempt.bind((LOOPBACK, port))
                _given.add(port)
                return port
    raise OSError(f"no free port on {LOOPBACK} between {_PORTS.start} and {_PORTS.stop}")


def url(port: int, scheme: str = "http") -> str:
    return f"{scheme}://{LOOPBACK}:{port}"


def answers(port: int, path: str, authority: Path | None = None) -> Probe:
    """Return a probe for a GET with status 200, by HTTPS if there is an authority's file."""
    context = ssl.create_default_context(cafile=str(authority)) if authority else False
    address = url(port, "https" if authority else "http") + path

    def probe() -> str | None:
        try:
            answer = httpx.get(address, verify=context, timeout=5, trust_env=False)
        except httpx.HTTPError as error:
            return f"{address}: {error}"
        told = f"{address} answers {answer.status_code}: {answer.text[:2000].strip()}"
        return None if answer.status_code == 200 else told

    return probe


def accepts(port: int) -> Probe:
    def probe() -> str | None:
        try:
            socket.create_connection((LOOPBACK, port), timeout=5).close()
        except OSError as error:
            return f"{LOOPBACK}:{port}: {error}"
        return None

    return probe
