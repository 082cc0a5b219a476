"""The text of a file that a person names on the command line."""

from __future__ import annotations

import sys
from pathlib import Path

from demandops.errors import InvalidInput


def read_input(file: str | Path) -> tuple[str, str]:
    """Return the name of a file for messages, and its text; ``-`` is standard input.

    Raises:
        InvalidInput: if it cannot be read or is not UTF-8.
    """
    name = "standard input" if file == "-" else str(file)
    try:
        data = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
        return name, data.decode("utf-8")
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
    except UnicodeDecodeError:
        problem = "is not UTF-8 text"
    raise InvalidInput.at("", problem, file=name)
