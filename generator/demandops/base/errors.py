"""The errors that every stage raises, and the faults that they carry.

A :class:`Fault` says where the problem is, what it is and how to fix it. An error carries all
faults that were found together, so that a person can fix a file or a request in one go.
``cli.main`` maps errors to exit codes, ``demandops_ros.actions`` maps them to action results.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import lru_cache

from demandops.base.quoting import clipped, escaped, one_line

# How many faults of one file, or of a request, are listed; further ones are only counted
MOST_FAULTS = 100
_LONGEST_FIELD = 2_000
# With more names, a word is compared only with its neighbors. The comparison is slow, and one file
# or goal may have thousands of unknown words.
_MOST_COMPARED = 12
_MOST_LISTED = 8


@dataclass(frozen=True, slots=True)
class Fault:
    """One problem in an input.

    ``code`` is a stable word for programs (``unknown-node``). ``field`` is the path inside the
    input (``apps[0].header.node_id``). ``message`` says what is wrong and how to fix it.
    """

    code: str
    field: str
    message: str
    file: str = ""
    line: int | None = None

    def __post_init__(self) -> None:
        # A message may quote any text of a file or a goal. Whoever prints it relies on one line.
        object.__setattr__(self, "message", one_line(self.message))

    def __str__(self) -> str:
        places = (one_line(place) for place in (self.place, self.field))
        return ": ".join(part for part in (*places, self.message) if part)

    @property
    def place(self) -> str:
        # editors and terminals turn `file:line` into a link
        if self.line is None:
            return self.file
        return f"{self.file}:{self.line}" if self.file else f"line {self.line}"

    def within(self, file: str) -> Fault:
        return replace(self, file=file)


class DemandOpsError(Exception):
    """Base of every error that this program raises on purpose.

    The text of an error is one line. The text of :class:`InvalidInput` has one line for each fault.
    ``code`` is a stable word for the clients of actions.
    """

    code = "state-repo"

    def __str__(self) -> str:
        return one_line(super().__str__())


class InvalidInput(DemandOpsError):
    """Raised when something that a person wrote is invalid; nothing was changed."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        # A file may have a fault on each of its lines, but a person and a page must show the text.
        kept: list[Fault] = []
        counts: dict[str, int] = {}
        for fault in faults:
            if fault.code == "more":  # from an error whose faults become part of this one
                kept.append(fault)
                continue
            count = counts[fault.file] = counts.get(fault.file, 0) + 1
            if count <= MOST_FAULTS:
                kept.append(replace(fault, field=clipped(fault.field, _LONGEST_FIELD)))
        for file, count in counts.items():
            if count > MOST_FAULTS:
                kept.append(Fault("more", "", f"has {count - MOST_FAULTS} more faults", file))
        self.faults = tuple(kept)
        self.code = kept[0].code if kept else ""
        super().__init__(self.faults)

    def __str__(self) -> str:
        return "\n".join(str(fault) for fault in self.faults)

    def text_with_codes(self) -> str:
        return "\n".join(f"{fault.code}: {fault}" for fault in self.faults)

    @classmethod
    def at(cls, field: str, message: str, *, code: str = "invalid", file: str = "") -> InvalidInput:
        return cls([Fault(code, field, message, file)])


class OverLimit(InvalidInput):
    """Raised when what a person wrote takes too long, or too much memory, to evaluate.

    The faults name the file. Whether this happens may depend on the machine, so such an error
    refuses a demand or fails a check, but never says whether a file is valid.
    """


class Refused(InvalidInput):
    """Raised when a demand cannot be fulfilled; no part of it was booked."""


class OverBudget(Exception):
    """Raised within a decision that takes more work than one demand may cause.

    The decision turns it into a refusal with the code ``too-large``.
    """

    # It is no Refused, so that nothing which looks for another way, such as another node, goes on
    # with the work.


class StateRepoError(DemandOpsError):
    """Raised when the state repo cannot be read or written; the message says how to fix it."""


class BeforeTheFirst(StateRepoError):
    """Raised for a time before the first commit."""

    def __init__(self, message: str, first: str) -> None:
        super().__init__(message)
        self.first = first  # the commit


class Withdrawn(DemandOpsError):
    """Raised when a demand is canceled, released or replaced before its commit."""

    code = "withdrawn"


class TurnedDown(DemandOpsError):
    """Raised when a person did not approve a demand that needed approval."""

    code = "turned-down"


class NotReached(DemandOpsError):
    """Raised when a published demand was not in time ``level``: reconciled or healthy."""

    def __init__(self, level: str, message: str) -> None:
        super().__init__(message)
        self.code = f"not-{level}"


class ShuttingDown(DemandOpsError):
    """Raised when a demand gets no answer because the generator stops.

    A demand that arrived before the stop stays in the journal, and the next start resumes it. A
    demand that arrives during the stop is not accepted. The message says which of both it is.
    """

    code = "shutting-down"


class Unsound(DemandOpsError):
    """Raised when a demand could be lost, booked twice, or answered by another process as well.

    No requester gets an answer, and the process ends with exit code 3.
    """

    # The next start reads the journal, and so finds what this process could not be sure about.


class QueueFull(DemandOpsError):
    """Raised when the queue is full, or when too many demands of the requester have no answer."""


def fault(field: str, message: str, *, code: str = "invalid", line: int | None = None) -> Fault:
    return Fault(code=code, field=field, message=message, line=line)


def field_path(location: tuple[int | str, ...]) -> str:  # like `nodes[3].cluster`
    path = ""
    for part in location:
        if isinstance(part, int):
            path += f"[{part}]"
        elif part != "[key]":  # pydantic adds it where the key of a mapping is wrong
            path += f".{part}" if path else part
    return escaped(path)


def internal(error: Exception) -> StateRepoError:
    return StateRepoError(f"internal error of the generator: {error!r}; see its log")


def closest(word: str, words: Iterable[str]) -> str | None:
    # among many words, one that is similar may be missed
    names = tuple(words)
    forwards, backwards = _orders(names)
    compared = forwards
    if len(names) > _MOST_COMPARED:
        compared = []
        # the order of the names read backwards finds a word whose beginning is mistyped
        for ordered, step in ((forwards, 1), (backwards, -1)):
            at = bisect(ordered, word[::step])
            compared += [name[::step] for name in ordered[max(0, at - 3) : at + 3]]
    close = get_close_matches(word, compared, n=1)
    return close[0] if close else None


def sentences(problems: Iterable[str]) -> str:
    return ". ".join(problems).replace("?. ", "? ")


def suggestion(word: str, words: Iterable[str]) -> str:
    """Return ``; did you mean 'x'?``, or ``; known: …``, or nothing if there are no words."""
    names = tuple(words)
    close = closest(word, names)
    if close:
        return f"; did you mean '{close}'?"
    if not names:
        return ""
    listed = ", ".join(_orders(names)[0][:_MOST_LISTED])
    return f"; known: {listed}" + (", …" if len(names) > _MOST_LISTED else "")


@lru_cache(maxsize=8)  # thousands of unknown words are looked for among the same names
def _orders(names: tuple[str, ...]) -> tuple[list[str], list[str]]:
    return sorted(names), sorted(name[::-1] for name in names)
