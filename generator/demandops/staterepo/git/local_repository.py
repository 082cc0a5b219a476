"""The state repo as a bare repository on this disk, written in place and fsynced."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pygit2
from pygit2 import Oid, Repository

from demandops.errors import StateRepoError
from demandops.runtime import REAL
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.git.new_objects import NewObjects
from demandops.staterepo.git.repository import MAIN, StateRepository

_STALE_LOCK_S = 5.0

log = logging.getLogger("demandops")


class LocalRepository(StateRepository):
    """A bare repository on this disk, written in place and fsynced."""

    always_current = True

    def __init__(self, path: Path) -> None:
        self.address = str(path)
        try:
            self.objects = Repository(str(path))
        except pygit2.GitError:
            raise StateRepoError(
                f"{path} is not a Git repository; make one with `demandops init {path} --bare`"
            ) from None
        self.new = NewObjects(self.objects)
        if MAIN not in self.objects.references:
            raise StateRepoError(
                f"{path} has no branch '{MAIN_BRANCH}'; make a state repo with "
                "`demandops init DIR --bare`"
            )
        if self.objects.branches.local[MAIN_BRANCH].is_checked_out():
            raise StateRepoError(
                f"{path} has '{MAIN_BRANCH}' checked out, so its files would become outdated; "
                f"use a bare clone: git clone --bare {path} {path}.git"
            )

    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        """Return the tip, which is always current."""
        return self.tip()

    def publish(self, expected: Oid, commit: Oid) -> bool:
        """Move the branch if it still is at ``expected``, checked under Git's lock."""
        reference = self.objects.references[MAIN]
        if reference.target != expected:
            return False
        try:
            with self.new.packed(commit):
                reference.set_target(commit, "demandops")
        except (pygit2.GitError, OSError):
            self._break_stale_lock()
            return False  # another writer holds the lock or was first: evaluate again
        return True

    def _break_stale_lock(self) -> None:
        """Remove the branch's lock if a killed process left it: Git holds it for milliseconds."""
        lock = Path(self.objects.path) / f"{MAIN}.lock"
        with suppress(FileNotFoundError):
            if REAL.now().timestamp() - lock.stat().st_mtime > _STALE_LOCK_S:
                log.warning("removing %s, which a killed process left behind", lock)
                lock.unlink()
