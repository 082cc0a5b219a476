"""Makes the page of error messages.

The messages are those in the tests' list of mistakes, and those that :mod:`.raised` finds in the
source.
"""

from __future__ import annotations

import re
from pathlib import Path

from docs_site import raised

MESSAGES = Path(__file__).parents[1] / "tests" / "unit" / "messages" / "messages.txt"
_END = "# fields"  # the rest, the forms of fields, is on the page of schemas


def page() -> str:
    """Return the page as Markdown: a section for each kind of input, a row for each mistake."""
    _, *sections = re.split(r"(?m)^# ", MESSAGES.read_text().partition(f"\n{_END}\n")[0])
    parts = [
        "# Errors and remedies",
        "Each mistake that the tests make, and the message that answers it, as `file: field: fault "
        "and remedy`. All faults of one input are reported together. The word in brackets at the "
        "end is the code that a ROS 2 client gets; without one it is `invalid`. … is the wording "
        "of a library. The last sections have what is told of the state repo, clusters and "
        "commands; there … is what differs each time.",
    ]
    for section in sections:
        title, _, body = section.partition("\n")
        cases = re.findall(r"^(\S.*)\n((?: {4}.*\n)+)", f"{body}\n", re.MULTILINE)
        rows = [
            f"| {mistake} | {'<br>'.join(map(_code, messages.splitlines()))} |"
            for mistake, messages in cases
        ]
        head = ["| mistake | message |", "| --- | --- |"]
        parts += [f"## {title[0].upper()}{title[1:]}", "\n".join([*head, *rows])]
    for title, messages in raised.messages().items():
        parts += [f"## {title}", "\n".join(f"- {_code(message)}" for message in messages)]
    return "\n\n".join(parts) + "\n"


def _code(message: str) -> str:
    """Return a message as code for a table's cell, with all marks of Markdown escaped."""
    text = re.sub(r"[^\w\s]", lambda mark: f"&#{ord(mark[0])};", message.strip())
    return f"<code>{text}</code>"
