"""Records whether the remote can be reached, for logs and diagnostics."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import datetime

from demandops.base.errors import Fault
from demandops.base.runtime import Runtime
from demandops.repo.git.repository import StateRepository
from demandops.repo.history import allowed_signers
from demandops.repo.load.snapshot import Snapshot

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


# ---- logs each problem of the state repo once, until it is mended ----


class FaultLog:
    def __init__(self, repository: StateRepository) -> None:
        self._repository = repository
        self._logged: frozenset[Fault] = frozenset()
        self._warned_of_signers = False

    def log_changes(self, problems: Iterable[Fault]) -> None:
        current = list(dict.fromkeys(problems))
        for problem in current:
            if problem not in self._logged:
                log.error("%s (its last valid version, if any, stays in effect)", problem)
        for file in sorted({old.file for old in self._logged} - {new.file for new in current}):
            log.info("%s is valid again", file or "the state repo")
        self._logged = frozenset(current)

    def warn_if_unsigned(self, snapshot: Snapshot) -> None:
        """Warn once if the state repo lists who may sign and this generator has no key."""
        if self._repository.signer is not None or self._warned_of_signers:
            return
        if allowed_signers.are_listed(self._repository.objects, snapshot.commit):
            self._warned_of_signers = True
            log.warning(
                "%s lists who may sign, but this generator has no key, so `verify` will refuse its "
                "commits, and generators will treat them as commits by a person; start the "
                "generator with --signing-key",
                allowed_signers.ALLOWED_SIGNERS,
            )
