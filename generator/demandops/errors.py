"""The errors that every stage raises, and the faults that they carry.

A :class:`Fault` says where the problem is, what it is and how to fix it. An error carries all
faults that were found together, so that a person can fix a file or a request in one go.
``cli.main`` maps errors to exit codes, ``demandops_ros.actions`` maps them to action results.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import lru_cache

from demandops.quoting import clipped, escaped, one_line

# How many faults of one file, or of a request, are listed; further ones are only counted
MOST_FAULTS = 100
_LONGEST_FIELD = 2_000
_MORE = "more"
_COMPARED = 12


@dataclass(frozen=True, slots=True)
class Fault:
    """One problem in an input.

    ``code`` is a stable word for programs (``unknown-node``). ``field`` is the path inside the
    input (``apps[0].header.node_id``). ``message`` says what is wrong and how to fix it, on one
    line. ``file`` names the file, if the input is a file. ``line`` is the line of the field, if it
    is known.
    """

    code: str
    field: str
    message: str
    file: str = ""
    line: int | None = None

    def __post_init__(self) -> None:
        """Escape and cut ``message``; ``file`` and ``field`` are escaped by :meth:`__str__`."""
        object.__setattr__(self, "message", one_line(self.message))

    def __str__(self) -> str:
        """Return ``file:line: field: message`` on one line, without the empty parts."""
        places = (one_line(place) for place in (self.place, self.field))
        return ": ".join(part for part in (*places, self.message) if part)

    @property
    def place(self) -> str:
        """The file and the line, as far as they are known: ``inventory/nodes.yaml:12``."""
        return place_text(self.file, self.line)

    def within(self, file: str) -> Fault:
        """Return the same fault, located in ``file``."""
        return replace(self, file=file)


def place_text(file: str, line: int | None) -> str:
    """Return ``file:line``, which editors and terminals turn into a link."""
    if line is None:
        return file
    return f"{file}:{line}" if file else f"line {line}"


class DemandOpsError(Exception):
    """Base of every error that this program raises on purpose.

    The text of an error is one line. The text of :class:`InvalidInput` has one line for each fault.
    """

    def __str__(self) -> str:
        """Return the text on one line, with an escape for each invisible character."""
        return one_line(super().__str__())


class InvalidInput(DemandOpsError):
    """Raised when something that a person wrote is invalid; nothing was changed."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        self.faults = tuple(_fewer(faults))
        super().__init__(self.faults)

    def __str__(self) -> str:
        """Return one line for each fault."""
        return "\n".join(str(fault) for fault in self.faults)

    def text_with_codes(self) -> str:
        """Return one line for each fault: ``<code>: `` and the fault's text."""
        return "\n".join(f"{fault.code}: {fault}" for fault in self.faults)

    @classmethod
    def at(cls, field: str, message: str, *, code: str = "invalid", file: str = "") -> InvalidInput:
        """Return an error with a single fault, made from the arguments."""
        return cls([Fault(code, field, message, file)])


def _fewer(faults: Iterable[Fault]) -> Iterator[Fault]:
    """Yield the first faults of each file, and one fault that says how many more the file has.

    Long field names are shortened. A fault with the code ``more``, from an earlier call, is kept.
    """
    counts: dict[str, int] = {}
    for fault in faults:
        if fault.code == _MORE:
            yield fault
            continue
        count = counts[fault.file] = counts.get(fault.file, 0) + 1
        if count <= MOST_FAULTS:
            yield replace(fault, field=clipped(fault.field, _LONGEST_FIELD))
    for file, count in counts.items():
        if count > MOST_FAULTS:
            yield Fault(_MORE, "", f"has {count - MOST_FAULTS} more faults", file)


class OverLimit(InvalidInput):
    """Raised when what a person wrote takes too long, or too much memory, to evaluate.

    The faults name the file. Whether this happens may depend on the machine, so such an error
    refuses a demand or fails a check, but never says whether a file is valid.
    """


class Refused(InvalidInput):
    """Raised when a demand cannot be fulfilled; no part of it was booked."""


class OverBudget(Exception):
    """Raised within a decision that takes more work than one demand may cause.

    It is no ``Refused``, so that nothing which looks for another way, such as another node, goes on
    with the work. The decision turns it into a refusal with the code ``too-large``.
    """


class StateRepoError(DemandOpsError):
    """Raised when the state repo cannot be read or written; the message says how to fix it."""


class Withdrawn(DemandOpsError):
    """Raised when a demand is canceled, released or replaced before its commit."""


class TurnedDown(DemandOpsError):
    """Raised when a person did not approve a demand that needed approval."""


class NotReached(DemandOpsError):
    """Raised when a published demand did not reach the requested level in time.

    ``level`` is the requested level: reconciled or healthy.
    """

    def __init__(self, level: str, message: str) -> None:
        super().__init__(message)
        self.level = level


class ShuttingDown(DemandOpsError):
    """Raised when a demand gets no answer because the generator stops.

    A demand that arrived before the stop stays in the journal, and the next start resumes it. A
    demand that arrives during the stop is not accepted. The message says which of both it is.
    """


class Unsound(DemandOpsError):
    """Raised when a demand could be lost, booked twice, or answered by another process as well.

    No requester gets an answer, and the process ends with exit code 3. The next start reads the
    journal.
    """


class QueueFull(DemandOpsError):
    """Raised when the queue is full, or when too many demands of the requester have no answer."""


def fault(field: str, message: str, *, code: str = "invalid", line: int | None = None) -> Fault:
    """Return a fault without a file; :meth:`Fault.within` adds the file later."""
    return Fault(code=code, field=field, message=message, line=line)


def field_path(location: tuple[int | str, ...]) -> str:
    """Return ``nodes[3].cluster`` for ``("nodes", 3, "cluster")``."""
    path = ""
    for part in location:
        if isinstance(part, int):
            path += f"[{part}]"
        elif part != "[key]":
            path += f".{part}" if path else part
    return escaped(path)


def internal(error: Exception) -> StateRepoError:
    """Return the error for a demand that failed because of a fault of the program."""
    return StateRepoError(f"internal error of the generator: {error!r}; see its log")


def closest(word: str, known: Iterable[str]) -> str | None:
    """Return a known word that is similar to ``word``, or None if none is found.

    If many words are known, only some of them are compared, so a similar word may be missed.
    """
    close = get_close_matches(word, _neighbors(word, tuple(known)), n=1)
    return close[0] if close else None


def sentences(problems: Iterable[str]) -> str:
    """Return one text in which each problem is a sentence."""
    return ". ".join(problems).replace("?. ", "? ")


def suggestion(word: str, known: Iterable[str], *, most: int = 8) -> str:
    """Return ``; did you mean 'x'?`` if a known word is similar to ``word``.

    Otherwise return ``; known: …`` with at most ``most`` known words. Return an empty string if no
    words are known.
    """
    words = tuple(known)
    names = _orders(words)[0]
    close = closest(word, words)
    if close:
        return f"; did you mean '{close}'?"
    if not names:
        return ""
    listed = ", ".join(names[:most]) + (", …" if len(names) > most else "")
    return f"; known: {listed}"


def _neighbors(word: str, names: tuple[str, ...]) -> list[str]:
    """Return the names that are worth comparing with a word.

    These are the word's neighbors in two orders: the alphabetical order, and the alphabetical order
    of the names read backwards. If there are few names, all are returned. To compare a word with
    thousands of names is slow, and one file or goal may have thousands of unknown words.
    """
    forwards, backwards = _orders(names)
    if len(names) <= _COMPARED:
        return forwards
    found = []
    for ordered, step in ((forwards, 1), (backwards, -1)):
        at = bisect(ordered, word[::step])
        found += [name[::step] for name in ordered[max(0, at - 3) : at + 3]]
    return found


@lru_cache(maxsize=8)  # thousands of unknown words are looked for among the same names
def _orders(names: tuple[str, ...]) -> tuple[list[str], list[str]]:
    return sorted(names), sorted(name[::-1] for name in names)
