"""The errors that every stage raises, and the faults that they carry.

A :class:`Fault` says where the problem is, what it is and how to fix it. An error carries all
faults that were found together, so that a person can fix a file or a request in one go.
``cli.main`` maps errors to exit codes, ``demandops_ros.node`` maps them to action results.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from difflib import get_close_matches

MOST_FAULTS = 100
"""The faults of one file, or of a request, that are told; the others are counted."""
_LONGEST_FIELD, _LONGEST_MESSAGE = 2_000, 4_000


@dataclass(frozen=True, slots=True)
class Fault:
    """One problem in an input.

    ``code`` is a stable word for programs (``unknown-node``). ``field`` is the path inside the
    input (``apps[0].header.node_id``). ``message`` says what is wrong and how to fix it. ``file``
    names the file, if the input is one.
    """

    code: str
    field: str
    message: str
    file: str = ""

    def __str__(self) -> str:
        """Return ``file: field: message`` without the empty parts."""
        return ": ".join(part for part in (self.file, self.field, self.message) if part)

    def within(self, file: str) -> Fault:
        """Return the same fault, located in ``file``."""
        return replace(self, file=file)


class DemandOpsError(Exception):
    """Base of every error that this program raises on purpose."""


class InvalidInput(DemandOpsError):
    """Raised when something that a person wrote is invalid; nothing was changed."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        self.faults = tuple(_fewer(faults))
        super().__init__("\n".join(str(fault) for fault in self.faults))

    @classmethod
    def at(cls, field: str, message: str, *, code: str = "invalid", file: str = "") -> InvalidInput:
        """Return the error with one fault."""
        return cls([Fault(code, field, message, file)])


def _fewer(faults: Iterable[Fault]) -> Iterator[Fault]:
    """Yield the first faults of each file, shortened, and how many more it has."""
    counts: dict[str, int] = {}
    for fault in faults:
        count = counts[fault.file] = counts.get(fault.file, 0) + 1
        if count <= MOST_FAULTS:
            yield replace(
                fault,
                field=_shortened(fault.field, _LONGEST_FIELD),
                message=_shortened(fault.message, _LONGEST_MESSAGE),
            )
    for file, count in counts.items():
        if count > MOST_FAULTS:
            yield Fault("more", "", f"has {count - MOST_FAULTS} more faults", file)


def _shortened(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


class Refused(InvalidInput):
    """Raised when a demand cannot be fulfilled; no part of it was booked."""


class StateRepoError(DemandOpsError):
    """Raised when the state repo cannot be read or written; the message says how to fix it."""


class Withdrawn(DemandOpsError):
    """Raised when the requester canceled its demand before the commit."""


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
    """Raised when a demand arrives while the generator stops."""


class Unsound(DemandOpsError):
    """Raised when going on could lose or double a demand: nobody is answered, the process ends.

    Its exit code is 3. The next start goes by the journal.
    """


class QueueFull(DemandOpsError):
    """Raised when the demand queue is full."""


def fault(field: str, message: str, *, code: str = "invalid") -> Fault:
    """Return a fault that is not in a file yet."""
    return Fault(code=code, field=field, message=message)


def quoted(value: str, most: int = 80) -> str:
    """Return foreign text for a message: quoted, printable, on one line and not too long."""
    text = value if value.isprintable() else value.encode("unicode_escape").decode()
    return f"'{text if len(text) <= most else text[: most - 1] + '…'}'"


def suggestion(word: str, known: Iterable[str], *, most: int = 8) -> str:
    """Return ``; did you mean 'x'?`` for a similar word, else the known words.

    Return an empty string if no words are known.
    """
    names = sorted(known)
    close = get_close_matches(word, names, n=1)
    if close:
        return f"; did you mean '{close[0]}'?"
    if not names:
        return ""
    listed = ", ".join(names[:most]) + (", …" if len(names) > most else "")
    return f"; known: {listed}"
