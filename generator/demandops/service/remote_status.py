"""Records whether the remote can be reached, for logs and diagnostics."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.runtime import Runtime

log = logging.getLogger("demandops")


@dataclass(frozen=True, slots=True)
class RemoteStatus:
    unreachable: str = ""  # why the remote cannot be read or written now
    push_denied: str = ""  # why the remote rejected the last push
    unreachable_since: datetime | None = None
    last_reached: datetime | None = None
    last_push: datetime | None = None


class RemoteMonitor:
    """Records and logs whether the remote can be reached; any thread may read ``status``."""

    def __init__(self, address: str, runtime: Runtime) -> None:
        self._address, self._runtime = address, runtime
        self.status = RemoteStatus()
        self._away_from = 0.0

    def record_unreachable(self, reason: str) -> None:
        since = self.status.unreachable_since
        if since is None:
            log.warning("%s; trying again until the state repo is back", reason)
            self._away_from = self._runtime.monotonic()  # as a person may set the other clock
        else:
            log.debug("%s", reason)
        since = since or self._runtime.now()
        self.status = replace(self.status, unreachable=reason, unreachable_since=since)

    def record_reached(self, *, pushed: bool = False) -> None:
        now, before = self._runtime.now(), self.status
        if before.unreachable_since is not None:
            away = self._runtime.monotonic() - self._away_from
            log.info("%s is back after %.0f s", self._address, away)
        self.status = RemoteStatus(
            push_denied="" if pushed else before.push_denied,
            last_reached=now,
            last_push=now if pushed else before.last_push,
        )

    def record_push_denied(self, reason: str) -> None:
        if reason != self.status.push_denied:
            log.error("%s", reason)
        self.record_reached()
        self.status = replace(self.status, push_denied=reason)
