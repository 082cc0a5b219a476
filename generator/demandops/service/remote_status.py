"""Whether the state repo can be reached and is valid, for logs and diagnostics."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from datetime import datetime, timezone

from demandops.errors import Fault

log = logging.getLogger("demandops")


@dataclass(frozen=True, slots=True)
class Contact:
    """What is known of reaching the state repo.

    ``trouble`` is why it cannot be read or written at the moment, since ``since``; ``denied`` why
    it took the last push not; ``pushed`` is when something was last published from here.
    """

    trouble: str = ""
    denied: str = ""
    since: datetime | None = None
    reached: datetime | None = None
    pushed: datetime | None = None


@dataclass(frozen=True, slots=True)
class Condition:
    """How it is with the state repo, for diagnostics.

    ``problems`` are what is not valid there, ``waiting`` the demands that are kept in the outbox,
    ``commit`` the newest commit that was taken in.
    """

    contact: Contact
    problems: tuple[Fault, ...]
    waiting: int
    commit: str


class Link:
    """Whether the state repo can be reached; ``contact`` may be read from any thread."""

    def __init__(self, address: str) -> None:
        self._address = address
        self.contact = Contact()

    @property
    def is_away(self) -> bool:
        """Whether the last that was heard is that it cannot be reached."""
        return bool(self.contact.trouble)

    def lost(self, reason: str) -> None:
        """Note that it cannot be reached or takes nothing; logged when it could before."""
        if not self.is_away:
            log.warning("%s; trying again until it is back", reason)
            self.contact = replace(self.contact, since=_now())
        else:
            log.debug("%s", reason)
        self.contact = replace(self.contact, trouble=reason)

    def reached(self, *, pushed: bool = False) -> None:
        """Note that it was reached; logged when it was away before."""
        now = _now()
        before = self.contact
        if before.trouble:
            away = (now - (before.since or now)).total_seconds()
            log.info("%s is back after %.0f s", self._address, away)
        self.contact = Contact(
            denied="" if pushed else before.denied,
            reached=now,
            pushed=now if pushed else before.pushed,
        )

    def denied(self, reason: str) -> None:
        """Note that it was reached and took no push; whoever waited for it is told."""
        self.reached()
        self.contact = replace(self.contact, denied=reason)


def _now() -> datetime:
    return datetime.now(timezone.utc)
