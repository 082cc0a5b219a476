"""Whether the state repo can be reached and is valid, for logs and diagnostics."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from datetime import datetime, timezone

from demandops.errors import Fault

log = logging.getLogger("demandops")


@dataclass(frozen=True, slots=True)
class RemoteStatus:
    """What is known of reaching the state repo.

    ``trouble`` is why it cannot be read or written at the moment, since ``since``; ``denied`` why
    it took the last push not; ``pushed`` is when something was last published from here.
    """

    unreachable: str = ""
    push_denied: str = ""
    unreachable_since: datetime | None = None
    last_reached: datetime | None = None
    last_push: datetime | None = None


@dataclass(frozen=True, slots=True)
class StateRepoStatus:
    """How it is with the state repo, for diagnostics.

    ``problems`` are what is not valid there, ``waiting`` the demands that are kept in the outbox,
    ``commit`` the newest commit that was taken in.
    """

    remote: RemoteStatus
    problems: tuple[Fault, ...]
    unpublished: int
    commit: str


class RemoteMonitor:
    """Whether the state repo can be reached; ``contact`` may be read from any thread."""

    def __init__(self, address: str) -> None:
        self._address = address
        self.status = RemoteStatus()

    @property
    def is_unreachable(self) -> bool:
        """Whether the last that was heard is that it cannot be reached."""
        return bool(self.status.unreachable)

    def record_unreachable(self, reason: str) -> None:
        """Note that it cannot be reached or takes nothing; logged when it could before."""
        if not self.is_unreachable:
            log.warning("%s; trying again until it is back", reason)
            self.status = replace(self.status, unreachable_since=_now())
        else:
            log.debug("%s", reason)
        self.status = replace(self.status, unreachable=reason)

    def record_reached(self, *, pushed: bool = False) -> None:
        """Note that it was reached; logged when it was away before."""
        now = _now()
        before = self.status
        if before.unreachable:
            away = (now - (before.unreachable_since or now)).total_seconds()
            log.info("%s is back after %.0f s", self._address, away)
        self.status = RemoteStatus(
            push_denied="" if pushed else before.push_denied,
            last_reached=now,
            last_push=now if pushed else before.last_push,
        )

    def record_push_denied(self, reason: str) -> None:
        """Note that it was reached and took no push; whoever waited for it is told."""
        self.record_reached()
        self.status = replace(self.status, push_denied=reason)


def _now() -> datetime:
    return datetime.now(timezone.utc)
