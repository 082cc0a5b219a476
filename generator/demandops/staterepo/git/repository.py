"""A state repo as the writer sees it: objects to read and write, and a tip that moves forward only.

There are two kinds, one on this disk and one behind a URL; :mod:`demandops.staterepo.git.connect`
chooses.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress

import git
import pygit2
from pygit2 import Oid, Repository

from demandops.errors import StateRepoError
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.git.signing import Signer

MAIN = f"refs/heads/{MAIN_BRANCH}"
TIMEOUT_S = 120
ENVIRONMENT = {"GIT_TERMINAL_PROMPT": "0", "LC_ALL": "C"}


class RemoteAway(StateRepoError):
    """The remote did not answer; what is kept in the outbox goes there when it is back."""


class FetchInterrupted(StateRepoError):
    """A look at the remote was ended because something more urgent came."""


class PushDenied(StateRepoError):
    """The remote answers and takes no push (a hook, a protected branch, missing rights)."""


class StateRepository(ABC):
    """A state repo: objects to read and write, and a tip that moves forward only."""

    objects: Repository
    address: str
    signer: Signer | None = None
    """Signs what is committed here; nothing: commits are not signed."""

    @abstractmethod
    def tip(self) -> Oid:
        """Return the newest published commit that is known here, without asking anybody."""

    @abstractmethod
    def refresh(self) -> Oid:
        """Ask where the state repo is now and return its newest commit.

        Raises:
            RemoteAway: where it cannot be reached.
        """

    def refresh_unless_urgent(self, urgent: Callable[[], bool]) -> Oid:
        """As :meth:`refresh`, but ended as soon as ``urgent`` says that something else is to do.

        Raises:
            RemoteAway: where it cannot be reached.
            FetchInterrupted: where it was ended.
        """
        return self.refresh()

    @abstractmethod
    def publish(self, expected: Oid, commit: Oid) -> bool:
        """Make ``commit`` the tip if the tip is ``expected``, durably; else return false.

        Raises:
            RemoteAway, PushDenied: where it could not be published for another reason.
        """

    def includes(self, commit: str, other: str) -> bool:
        """Tell whether ``commit`` is ``other`` or comes after it; false for one not known here.

        May be called from any thread: it opens the objects anew.
        """
        if commit == other:
            return True
        try:
            return Repository(self.objects.path).descendant_of(commit, other)
        except (pygit2.GitError, KeyError, ValueError):
            return False

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        """Tell whether two commits hold the same under ``path``; false for one not known here.

        May be called from any thread.
        """
        objects = Repository(self.objects.path)
        one, two = (_under(objects, name, path) for name in (commit, other))
        return one is not None and one == two

    def changed_paths(self, since: str, commit: str) -> list[str] | None:
        """Return the paths in which two commits differ; None where one is not known here.

        May be called from any thread.
        """
        objects = Repository(self.objects.path)
        try:
            found = objects.diff(objects[since].id, objects[commit].id)
        except (pygit2.GitError, KeyError, ValueError):
            return None
        ends = (end for delta in found.deltas for end in (delta.old_file, delta.new_file))
        return sorted({end.path for end in ends})

    def abort(self) -> None:  # noqa: B027 - a repository on this disk has nothing to end
        """End what is under way with a remote; nothing where there is none."""

    def tidy(self) -> None:
        """Let git pack loose objects, if there are many; it does so in a process of its own."""
        with suppress(git.GitCommandError), git.Repo(self.objects.path) as repo:
            _git(repo, "gc", "--auto", "--quiet")

    @property
    @abstractmethod
    def always_current(self) -> bool:
        """Tell whether :meth:`tip` can never be behind (a repository on this disk)."""


def _under(objects: Repository, commit: str, path: str) -> Oid | None:
    """Return the id of what a commit holds under a path, or None."""
    try:
        tree = objects[commit].peel(pygit2.Tree)
        return tree.id if path in ("", ".") else tree[path].id
    except (pygit2.GitError, KeyError, ValueError):
        return None


def _git(repo: git.Repo, *command: str) -> None:
    """Run a git command that talks to the remote.

    In a session of its own: Ctrl-C goes to every process of the terminal, and must not cut off a
    push that the generator is waiting for.
    """
    with repo.git.custom_environment(**ENVIRONMENT):
        repo.git.execute(
            [repo.git.GIT_PYTHON_GIT_EXECUTABLE, *command],
            kill_after_timeout=TIMEOUT_S,
            start_new_session=True,
        )
