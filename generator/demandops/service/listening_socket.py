"""Opens the listening socket of a server, at an address that an operator configured."""

from __future__ import annotations

import errno
import ipaddress
import re
import socket
from typing import Any

from demandops.errors import InvalidInput
from demandops.quoting import quoted

_PORT = re.compile(r"[0-9]{1,5}")
_REMEDIES = {
    errno.EADDRNOTAVAIL: "write an address of this machine",
    errno.EACCES: "choose a port above 1023",
}


def bound(address: str, option: str) -> socket.socket:
    """Return a socket that listens on ``host:port``; port 0 picks a free port.

    Raises:
        InvalidInput: the socket cannot listen on the address; the error names the option.
    """
    host, colon, port = address.rpartition(":")
    if not colon or not host or not _PORT.fullmatch(port) or int(port) > 0xFFFF:
        raise InvalidInput.at(
            option,
            f"{quoted(address)} is not an address to listen on; write one like 127.0.0.1:8090",
        )
    family, resolved = _resolved(
        host.removeprefix("[").removesuffix("]"), int(port), address, option
    )
    made = socket.socket(family)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(resolved)
        made.listen()
    except OSError as error:
        made.close()
        remedy = _REMEDIES.get(error.errno or 0, "choose another port")
        raise InvalidInput.at(
            option, f"cannot listen on '{address}': {error.strerror}; {remedy}"
        ) from None
    return made


def is_local(listening: socket.socket) -> bool:
    """Return whether only programs on this machine can connect."""
    host = listening.getsockname()[0]
    return ipaddress.ip_address(host.partition("%")[0]).is_loopback


def url_of(listening: socket.socket) -> str:
    """Return the URL of the server, without a path."""
    host, port = listening.getsockname()[:2]
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"


def _resolved(host: str, port: int, address: str, option: str) -> tuple[socket.AddressFamily, Any]:
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        raise InvalidInput.at(
            option,
            f"'{address}': host '{host}' cannot be resolved; write an address of this machine",
        ) from None
    return found[0][0], found[0][4]
