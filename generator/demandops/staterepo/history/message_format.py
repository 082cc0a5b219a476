"""The text of commit messages: paragraphs of lines, and trailers in the last paragraph.

Only this module writes and reads messages. A line of a paragraph is for people: its text is
escaped and shortened. A trailer is for programs: its value is read back exactly. A value of visible
characters on which no forge acts is written unchanged, so
``git log --format='%(trailers:key=Requester)'`` shows it; any other value is written in double
quotes with escapes like ``\\u202e``. So no value can begin a line, end the message, look like a
trailer or give a forge an order. Messages of earlier versions, which did not quote, are read
the same way.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from demandops.quoting import escaped, harmless, is_visible, one_line

Trailers = Iterable[tuple[str, str]]

_WHY = "Why: "
_AS_WRITTEN = ("Reason",)  # the person who runs a command may close an issue with it
_KEY = re.compile(r"[A-Za-z0-9-]+")
_ESCAPE = r"\\(?:x[0-9a-f]{2}|u[0-9a-f]{4}|U00(?:0[0-9a-f]|10)[0-9a-f]{4}|[nrt\\\"])"
_ESCAPES = re.compile(_ESCAPE)
_EDGES, _SPACE = re.compile(r"\A | \Z"), r"\\x20"
# A quoted value has an escape, because values without escapes are not quoted.
_QUOTED = re.compile(rf'"(?=.*\\)(?:[^"\\]|{_ESCAPE})*"')


@dataclass(frozen=True, slots=True)
class MessageText:
    summary: str
    why: str
    trailers: dict[str, list[str]]


def compose(paragraphs: Iterable[Iterable[str]], trailers: Trailers) -> str:
    """Return a message: paragraphs, each a list of lines, then the trailers.

    Empty paragraphs, and trailers with an empty value, are left out.
    """
    lines = [f"{key}: {_encoded(key, value)}" for key, value in trailers if value]
    body = ("\n".join(harmless(one_line(line)) for line in lines) for lines in paragraphs)
    return "\n\n".join(text for text in (*body, "\n".join(lines)) if text) + "\n"


def parse(message: str) -> MessageText:
    lines = message.split("\n")
    whys = (line.removeprefix(_WHY) for line in lines if line.startswith(_WHY))
    trailers: dict[str, list[str]] = {}
    head, _, last = message.rstrip("\n").rpartition("\n\n")
    for line in last.split("\n") if head else ():
        key, colon, value = line.partition(": ")
        if not colon or not _KEY.fullmatch(key):
            trailers.clear()  # a paragraph with any other line is text for people
            break
        trailers.setdefault(key, []).append(_decoded(value))
    return MessageText(lines[0], next(whys, ""), trailers)


def _encoded(key: str, value: str) -> str:
    is_plain = is_visible(value) and value == value.strip() and not _QUOTED.fullmatch(value)
    if is_plain and (key in _AS_WRITTEN or harmless(value) == value):
        return value
    text = escaped(value.replace("\\", r"\\").replace('"', r"\""))
    return f'"{_EDGES.sub(_SPACE, harmless(text))}"'


def _decoded(text: str) -> str:
    if not _QUOTED.fullmatch(text):
        return text
    return _ESCAPES.sub(
        lambda escape: (
            escape[0][1] if escape[0][1] in '\\"' else escape[0].encode().decode("unicode_escape")
        ),
        text[1:-1],
    )
