"""Reads files that a person names for a command or for the service: texts and secrets."""

from __future__ import annotations

import sys
from pathlib import Path

from demandops.errors import InvalidInput


def read_input(file: str | Path) -> tuple[str, str]:
    """Return a file's name, as messages give it, and its text. ``-`` is standard input."""
    name = "standard input" if file == "-" else str(file)
    try:
        data = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
        return name, data.decode("utf-8")
    except UnicodeDecodeError:
        problem = "is not UTF-8 text; save it as UTF-8"
    except (OSError, ValueError) as error:  # a ValueError if the path has the character NUL
        problem = f"cannot be read: {getattr(error, 'strerror', None) or error}; check the path"
    raise InvalidInput.at("", problem, file=name)


def read_secret(path: Path, *, private: bool = False) -> bytes:
    """Return the secret in a file; ``private`` refuses a file on which everybody has a right."""
    secret = b""
    try:
        # the group may have rights: a Secret's volume in Kubernetes gives the file to fsGroup
        if private and path.stat().st_mode & 0o007:
            problem = "is open to everybody on this machine; run chmod o= on it"
        else:
            # editors and `echo` end a file with a line break, which is no part of the secret
            secret = path.read_bytes().rstrip(b"\r\n")
            problem = "is empty; write the secret into this file"
    except (OSError, ValueError) as error:  # a ValueError if the path has the character NUL
        why = getattr(error, "strerror", None) or error
        problem = f"cannot be read: {why}; write the secret into this file, and make it readable"
    if not secret.strip():
        raise InvalidInput.at("", problem, file=str(path))
    return secret
