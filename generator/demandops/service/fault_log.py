"""Logs each problem of the state repo once, until it is mended."""

from __future__ import annotations

import logging
from collections.abc import Iterable

from demandops.errors import Fault
from demandops.staterepo.git.repository import StateRepository
from demandops.staterepo.history import allowed_signers
from demandops.staterepo.load.snapshot import Snapshot

log = logging.getLogger("demandops")


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
