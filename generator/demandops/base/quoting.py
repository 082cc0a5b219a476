"""Makes text from outside safe to print, for people and programs that read line by line.

A value from a goal, a file, a commit, a remote or an exception may hold any text. Code that prints
the value uses this module, so that the value cannot begin a new line, control a terminal, reorder
or hide text, or fill a screen. Visible text stays as it is.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Sequence
from typing import Any

# The longest line of text from outside, in characters; the rest is cut off
LONGEST_LINE = 4000

_INVISIBLE = "\u034f\u115f-\u1160\u17b4-\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\uffa0"
# Matches characters that are displayed as nothing, although Python calls them printable
_HIDDEN = re.compile(f"[{_INVISIBLE}\U0001d159\U000e0100-\U000e01ef]")


def is_visible(text: str) -> bool:
    return text.isprintable() and not _HIDDEN.search(text)


def escaped(text: str, kept: str = "") -> str:  # like `\u202e`
    if is_visible(text):
        return text
    return "".join(
        char if char in kept or is_visible(char) else char.encode("unicode_escape").decode()
        for char in text
    )


# Matches text that ends in the character at which a forge, or a pipeline, takes it for an order.
# The last line is for an issue elsewhere, `Closes ABC-1`.
_TRIGGER = re.compile(
    r"""
    (?<![A-Za-z0-9_])@(?=[A-Za-z0-9_])       # @name, @org/team
    | \#(?=[A-Za-z0-9_]) | [!&$](?=[0-9])     # #1, o/r#1, Jira's #close; GitLab's !1, &1, $1
    | (?<=\bGH)-(?=[0-9])                    # GH-1
    | /(?=(?:issues|pulls?|merge_requests|work_items|epics)/[0-9])  # https://host/o/r/issues/1
    | \[(?=[^][]*(?:skip|ci)|[a-z_]+:)       # [skip ci], [no ci]; GitLab's [issue:1]
    | \*(?=\*\*)                             # ***NO_CI***
    | \b(?:clos|fix|resolv|implement)[a-z]*:?\s+(?:issues?\s+)?[A-Z][A-Z0-9_]*-(?=[0-9])
    """,
    re.IGNORECASE | re.VERBOSE,
)


def harmless(text: str) -> str:
    """Return text that no forge acts on, with an escape like ``\\x40`` in the place of ``@``."""
    # Forges look into commit messages, titles and texts of pull requests: `[skip ci]` stops a
    # pipeline, `Fixes #1` closes an issue, `@name` calls a person.
    return _TRIGGER.sub(lambda match: f"{match[0][:-1]}\\x{ord(match[0][-1]):02x}", text)


def count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def some(names: Sequence[str], most: int) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def clipped(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1].rstrip() + "…"


def one_line(text: str, most: int = LONGEST_LINE) -> str:
    # cut before the escape too, because a text of megabytes would be escaped character by character
    return clipped(escaped(text[: most + 1]), most)


def lines(text: str) -> str:
    return escaped(text, kept="\n\t")


def quoted(value: str, most: int = 80) -> str:
    return f"'{one_line(value, most)}'"


def json_escaped(text: str) -> str:
    """Return JSON text of the same data, with JSON's escape for each invisible character."""
    if is_visible(text.replace("\n", "")):
        return text

    def escape(char: str) -> str:
        if char == "\n" or is_visible(char):
            return char
        # json.dumps knows the two escapes beyond 16 bits, but leaves DEL as it is
        return json.dumps(char)[1:-1] if ord(char) > 0xFFFF else f"\\u{ord(char):04x}"

    return "".join(map(escape, text))


class OneLineFormatter(logging.Formatter):
    """A traceback follows on lines of its own."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        record.message = one_line("; ".join(record.message.splitlines()))
        return super().formatMessage(record)

    def formatException(self, info: Any) -> str:  # noqa: ANN401 - as the base class has it
        # indented, so that no line of it looks like a log record
        return lines(super().formatException(info)).replace("\n", "\n  ")
