"""Reads files that a person names for a command or for the service: texts and secrets."""

from __future__ import annotations

import sys
from pathlib import Path

from demandops.errors import InvalidInput


def read_input(file: str | Path) -> tuple[str, str]:
    """Return a file's name, as messages give it, and its text. ``-`` is standard input.

    Raises:
        InvalidInput: if the file cannot be read or is not UTF-8.
    """
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
    """Return the secret in a file, without the line ends at its end.

    Args:
        path: the file.
        private: whether to refuse a file on which everybody has a right; its group may have rights.

    Raises:
        InvalidInput: if the file holds no secret, cannot be read, or is not private enough.
    """
    secret = b""
    try:
        if private and path.stat().st_mode & 0o007:
            problem = "is open to everybody on this machine; run chmod o= on it"
        else:
            secret = path.read_bytes().rstrip(b"\r\n")
            problem = "is empty; write the secret into this file"
    except (OSError, ValueError) as error:  # a ValueError if the path has the character NUL
        why = getattr(error, "strerror", None) or error
        problem = f"cannot be read: {why}; write the secret into this file, and make it readable"
    if not secret.strip():
        raise InvalidInput.at("", problem, file=str(path))
    return secret
