"""The problem report: a file in the state repo that lists the invalid files.

The report names the first 100 faults and counts the others. A fault has the commit that caused it
and the author of the commit, if the commit was found. The same problems give the same bytes, so an
unchanged report causes no commit. This module only converts between problems and text; it reads and
writes no files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass

from demandops import strict_yaml
from demandops.errors import Fault, InvalidInput, place_text
from demandops.quoting import is_visible, one_line
from demandops.settings import API_VERSION, NOTES_ROOT

PATH = f"{NOTES_ROOT}/reports/problems.yaml"
_HEAD = (
    "# Written by the generator: the files that are not valid. The last valid version of each\n"
    "# stays in effect until the file is fixed. The generator then removes this report.\n"
)
_MOST = 100
_WRITTEN = ("file", "field", "message", "since", "author")


@dataclass(frozen=True, slots=True)
class Problem:
    """A fault, with the id and the author of the commit that caused it, or empty texts."""

    file: str
    field: str
    message: str
    since: str = ""
    author: str = ""
    # not written to the report: ``Reader.problems`` finds it in the file
    line: int | None = None

    def __str__(self) -> str:
        places = (place_text(self.file, self.line), self.field)
        text = ": ".join(part for part in (*places, self.message) if part)
        if not self.since:
            return text
        return f"{text} (since {self.since[:10]} by {self.author})"


# From a file's path to the commit that caused the file's fault: its id and author.
Origin = Callable[[str], tuple[str, str] | None]


def with_origins(
    faults: Iterable[Fault], reported: Iterable[Problem], origin: Origin
) -> tuple[Problem, ...]:
    """Return a problem for each fault, with the commit and author of one that is ``reported``."""
    existing = {(old.file, old.field, old.message): old for old in reported if old.since}
    places = sorted({(fault.file, fault.field, fault.message) for fault in faults})
    problems = []
    for place in places[:_MOST]:
        file, field, message = map(one_line, place)
        if (file, field, message) in existing:
            problems.append(existing[file, field, message])
            continue
        commit, author = origin(place[0]) or ("", "")
        problems.append(Problem(file, field, message, commit, one_line(author)))
    # What the report has no room for gets no commit: it would have to be sought at each demand.
    return (*problems, *(Problem(*place) for place in places[_MOST:]))


def write(problems: tuple[Problem, ...]) -> str | None:
    if not problems:
        return None
    data: dict[str, object] = {
        "apiVersion": API_VERSION,
        "kind": "ProblemReport",
        "problems": [
            {name: value for name, value in asdict(problem).items() if value}
            for problem in problems[:_MOST]
        ],
    }
    if len(problems) > _MOST:
        data["more"] = len(problems) - _MOST
    return _HEAD + strict_yaml.dump(data)


def read(text: str | None) -> tuple[Problem, ...]:
    """Return the problems of a report; none if it is missing or a person made it unreadable."""
    try:
        data = strict_yaml.load(text or "")
    except InvalidInput:
        return ()

    def visible(value: object) -> str:
        return value if isinstance(value, str) and is_visible(value) else ""

    entries = data.get("problems") if isinstance(data, dict) else None
    return tuple(
        Problem(**{name: visible(entry.get(name)) for name in _WRITTEN})  # type: ignore[arg-type]
        for entry in (entries if isinstance(entries, list) else ())
        if isinstance(entry, dict)
    )
