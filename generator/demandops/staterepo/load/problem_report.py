"""What is not valid in a state repo, as a file of its own that the generator writes there.

Whoever broke a file sees in the repo what is wrong with it, since which of their commits, and that
its last valid version is in force. Pure: texts and faults in, text out. The same problems give the
same bytes whoever reports them, so a report that stands causes no commit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from demandops import strict_yaml
from demandops.errors import Fault, InvalidInput
from demandops.settings import API_VERSION, NOTES_ROOT

PATH = f"{NOTES_ROOT}/reports/problems.yaml"
_HEAD = (
    "# Written by the generator: files here that are not valid. Of each the last valid version\n"
    "# is in force until it is mended; then this report goes by itself.\n"
)
_MOST = 100


@dataclass(frozen=True, slots=True)
class Problem:
    """A fault, and the commit that it came with: its id and its author."""

    file: str
    field: str
    message: str
    since: str = ""
    author: str = ""

    def __str__(self) -> str:
        """Return where and what, and since when."""
        text = ": ".join(part for part in (self.file, self.field, self.message) if part)
        if not self.since:
            return text
        return f"{text} (since {self.since[:10]} of {self.author})"


Origin = Callable[[str], tuple[str, str] | None]
"""Gives for a path the commit and the author that a fault in it came with."""


def with_origins(
    faults: Iterable[Fault], known: Iterable[Problem], origin: Origin
) -> tuple[Problem, ...]:
    """Return a problem for each fault; one that is known keeps what is said of its origin."""
    standing = {(one.file, one.field, one.message): one for one in known if one.since}
    found = []
    for fault in sorted({(fault.file, fault.field, fault.message) for fault in faults}):
        if fault in standing:
            found.append(standing[fault])
            continue
        commit, author = origin(fault[0]) or ("", "")
        found.append(Problem(*fault, commit, author))
    return tuple(found)


def write(problems: tuple[Problem, ...]) -> str | None:
    """Return the file for these problems, or nothing where there are none."""
    if not problems:
        return None
    data: dict[str, object] = {
        "apiVersion": API_VERSION,
        "kind": "ProblemReport",
        "problems": [_entry(problem) for problem in problems[:_MOST]],
    }
    if len(problems) > _MOST:
        data["more"] = len(problems) - _MOST
    return _HEAD + strict_yaml.dump(data)


def _entry(problem: Problem) -> dict[str, str]:
    entry = {
        "file": problem.file,
        "field": problem.field,
        "message": problem.message,
        "since": problem.since,
        "author": problem.author,
    }
    return {name: value for name, value in entry.items() if value}


def read(text: str | None) -> tuple[Problem, ...]:
    """Return the problems of a file; of one that is no report, or none, none."""
    try:
        data = strict_yaml.load(text or "")
    except InvalidInput:
        return ()
    entries = data.get("problems") if isinstance(data, dict) else None
    return tuple(
        Problem(**{name: _text(entry.get(name)) for name in Problem.__dataclass_fields__})
        for entry in (entries if isinstance(entries, list) else ())
        if isinstance(entry, dict)
    )


def _text(value: object) -> str:
    """Return a text as it may be shown: people may have written the file too."""
    return value if isinstance(value, str) and value.isprintable() else ""
