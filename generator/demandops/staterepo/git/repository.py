"""The state repo that a writer uses: Git objects, and a tip that only moves forward.

There are two kinds, on this disk and behind a URL; :mod:`demandops.staterepo.git.address` chooses.
"""

from __future__ import annotations

import os
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable

import pygit2
from pygit2 import Oid, Repository, Tree

from demandops.errors import StateRepoError
from demandops.runtime import REAL, Runtime
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.new_objects import NewObjects
from demandops.staterepo.git.signing import Signer

MAIN = f"refs/heads/{MAIN_BRANCH}"
TIMEOUT_S = 120
_REPACK = ("repack", "--geometric=2", "-d", "-l", "--quiet")
ENVIRONMENT = {"GIT_TERMINAL_PROMPT": "0", "LC_ALL": "C"}


class RemoteAway(StateRepoError):
    """The remote cannot be reached; the journal keeps the demands until it is back."""


class FetchInterrupted(StateRepoError):
    """A fetch was ended because something was more urgent."""


class PushDenied(StateRepoError):
    """The remote rejects the push (a hook, a protected branch, missing rights)."""


class StateRepository(ABC):
    """A state repo: Git objects to read and write, and a tip that only moves forward."""

    objects: Repository
    new: NewObjects
    """What was written since the last publication."""
    address: str
    signer: Signer | None = None
    """Signs the commits made here; None: they are not signed."""
    runtime: Runtime = REAL
    """The clock, chance and threads of whoever writes to it."""
    always_current: bool
    """Whether :meth:`tip` is never out of date (a repository on this disk)."""
    _tidying: subprocess.Popen[bytes] | None = None
    main_reference = MAIN
    """The branch, or its remote-tracking branch of the last fetch."""

    def tip(self) -> Oid:
        """Return the newest published commit that is known here; does not ask the remote."""
        target = self.objects.references[self.main_reference].target
        assert isinstance(target, Oid)  # noqa: S101 - a branch points to a commit
        return target

    @abstractmethod
    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        """Fetch and return the newest published commit, or raise RemoteAway.

        Raises FetchInterrupted as soon as ``urgent`` returns true.
        """

    @abstractmethod
    def publish(self, expected: Oid, commit: Oid) -> bool:
        """Make ``commit`` the tip, durably, if the tip is ``expected``; else return false.

        Raises RemoteAway or PushDenied if it could not be published for another reason.
        """

    def includes(self, commit: str, other: str) -> bool:
        """Return whether ``commit`` is ``other`` or a descendant; false if one is not here.

        May be called from any thread: it opens the repository again.
        """
        if commit == other:
            return True
        try:
            return Repository(self.objects.path).descendant_of(commit, other)
        except (pygit2.GitError, KeyError, ValueError):
            return False

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        """Return whether ``path`` is equal in two commits; false if one is not known here."""
        found = self._trees(commit, other)
        if found is None:
            return False
        if path in ("", "."):
            return found[0].id == found[1].id
        return trees.entry(found[0], path) is not None and not trees.differ(*found, (path,))

    def changed_paths(self, since: str, commit: str) -> list[str] | None:
        """Return the paths in which two commits differ; None if one is not known here."""
        found = self._trees(since, commit)
        return None if found is None else sorted(path for path, _ in trees.differences(*found))

    def _trees(self, one: str, other: str) -> tuple[Tree, Tree] | None:
        objects = Repository(self.objects.path)  # opened again, so any thread may ask
        try:
            return trees.commit_of(objects, one).tree, trees.commit_of(objects, other).tree
        except StateRepoError:
            return None

    def abort(self) -> None:  # noqa: B027 - a repository on this disk has nothing to end
        """End the running transfer with a remote, if any."""

    def tidy(self) -> None:
        """Have git join the packs, beside what else happens, unless it still does."""
        if self._tidying is not None and self._tidying.poll() is None:
            return
        self._tidying = subprocess.Popen(
            ["git", *_REPACK],
            cwd=self.objects.path,
            env=os.environ | ENVIRONMENT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # so that Ctrl-C does not end it
        )
