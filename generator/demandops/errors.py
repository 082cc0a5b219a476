"""The one vocabulary of failure.

First in the flow: every stage raises these and none formats its own. A :class:`Fault` says where,
what and how to mend it; an error carries all faults that were found together, so that a person
mends a file or a request in one go. Exit codes and action results are made from these in one
place each (``cli.main`` and ``demandops_ros.node``).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from difflib import get_close_matches


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing wrong with an input.

    ``code`` is a stable word for programs (``unknown-node``), ``field`` the path inside the input
    (``apps[0].header.node_id``), ``message`` says what is wrong and how to mend it, ``file`` names
    the file where there is one.
    """

    code: str
    field: str
    message: str
    file: str = ""

    def __str__(self) -> str:
        """Return ``file: field: message`` without the parts that are empty."""
        return ": ".join(part for part in (self.file, self.field, self.message) if part)

    def within(self, file: str) -> Fault:
        """Return the same fault, told to be in ``file``."""
        return replace(self, file=file)


class DemandOpsError(Exception):
    """Anything this program raises on purpose."""


class InvalidInput(DemandOpsError):
    """Something a person wrote is wrong and theirs to mend; nothing was changed."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("\n".join(str(fault) for fault in self.faults))


class Refused(InvalidInput):
    """A demand that cannot be honoured; nothing of it was booked."""


class StateRepoError(DemandOpsError):
    """The state repo cannot be read or written; the message says how to mend it."""


class Withdrawn(DemandOpsError):
    """A demand that its requester took back before it was committed."""


class TurnedDown(DemandOpsError):
    """A demand that needed approval, and that a person did not approve."""


class NotReached(DemandOpsError):
    """A demand that is booked and published, and was not as far as asked in time.

    ``level`` is how far it was to be: reconciled or healthy.
    """

    def __init__(self, level: str, message: str) -> None:
        super().__init__(message)
        self.level = level


class ShuttingDown(DemandOpsError):
    """A demand that came after the generator was told to stop."""


class QueueFull(DemandOpsError):
    """More demands are waiting than the generator is set to hold."""


def fault(field: str, message: str, *, code: str = "invalid") -> Fault:
    """Return a fault; short because it is written often."""
    return Fault(code=code, field=field, message=message)


def quoted(value: str, most: int = 80) -> str:
    """Return what somebody wrote, in quotes, for a message: of one line, short, without tricks."""
    text = value if value.isprintable() else value.encode("unicode_escape").decode()
    return f"'{text if len(text) <= most else text[: most - 1] + '…'}'"


def suggestion(word: str, known: Iterable[str], *, most: int = 8) -> str:
    """Return ``; did you mean 'x'?``, or what is known where nothing comes near, or nothing."""
    names = sorted(known)
    close = get_close_matches(word, names, n=1)
    if close:
        return f"; did you mean '{close[0]}'?"
    if not names:
        return ""
    listed = ", ".join(names[:most]) + (", …" if len(names) > most else "")
    return f"; known: {listed}"
