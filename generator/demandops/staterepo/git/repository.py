"""The base class of state repos: Git objects, and a tip that only moves forward.

A state repo is on this disk or behind a URL. Each of the two has a subclass, and
:mod:`demandops.staterepo.git.open_repository` chooses between them.
"""

from __future__ import annotations

import errno
import os
import re
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pygit2
from pygit2 import Oid, Repository, Tree

from demandops.errors import StateRepoError, Unsound
from demandops.runtime import REAL, Runtime
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.git import child_processes
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.new_objects import NewObjects
from demandops.staterepo.git.signing import Signer

MAIN = f"refs/heads/{MAIN_BRANCH}"
TIMEOUT_S = 120
_REPACK = ("repack", "--geometric=2", "-d", "-l", "--quiet")
_ENVIRONMENT = {
    "GIT_TERMINAL_PROMPT": "0",
    "LC_ALL": "C",
    # git ends an HTTP transfer with less than 1 byte a second for 60 seconds
    "GIT_HTTP_LOW_SPEED_LIMIT": "1",
    "GIT_HTTP_LOW_SPEED_TIME": "60",
}


def git_environment() -> dict[str, str]:
    """Return the environment variables that git gets in addition to those of this process."""
    return _ENVIRONMENT | child_processes.mark()


class Unavailable(StateRepoError):
    """Raised when the state repo cannot be read or written now, but perhaps later.

    A generator keeps its demands in the journal and tries again.
    """


class RemoteAway(Unavailable):
    """Raised when git cannot fetch from the remote or push to it now, for example without network.

    Missing rights to fetch, and a push that the remote rejects for a temporary reason, count too.
    """


class DiskFull(Unavailable):
    """Raised when the disk of the state repo, or of its clone, has no room."""


class FetchInterrupted(StateRepoError):
    """Raised when a fetch was stopped for more urgent work, like a new demand."""


class PushDenied(StateRepoError):
    """Raised when a write fails for a reason that another attempt does not change.

    Examples are a hook, a protected branch, missing rights, a read-only file system, and a checkout
    as the state repo.
    """


_OBJECT = re.compile("[0-9a-f]{40}")
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NOT_ALLOWED = (errno.EACCES, errno.EPERM, errno.EROFS)
_BROKEN = (errno.EIO, errno.EUCLEAN, errno.ENODEV, errno.ENXIO, errno.ESTALE)
_TOLD = {os.strerror(number): number for number in (*_NO_ROOM, *_NOT_ALLOWED, *_BROKEN)}
_TOLD["failed to refresh packfiles"] = errno.EIO  # libgit2 could not list objects/pack


def disk_error(error: Exception, address: str) -> StateRepoError | Unsound | None:
    """Return the error to raise if a read or a write failed because of the disk, else None.

    ``error`` is the error of the read or write. libgit2 gives the system's error only as text, so
    this function recognizes the text. For an I/O error, it returns Unsound, because the content of
    the disk is then unknown.
    """
    number = getattr(error, "errno", None)
    if number is None:
        what = next((text for text in _TOLD if str(error).endswith(text)), "")
        number = _TOLD.get(what)
    else:
        what = os.strerror(number)
    if number in _NO_ROOM:
        return DiskFull(f"{address} cannot be written: its disk has no room ({what}); free some")
    if number == errno.EROFS:
        return PushDenied(f"{address} cannot be written: {what}; make its file system writable")
    if number in _NOT_ALLOWED:
        return PushDenied(
            f"{address} cannot be used: {what}; give the user of this program the right to read "
            "and write all files and folders there"
        )
    if number in _BROKEN:
        return Unsound(f"{address} cannot be used: {what}; check its disk, then start again")
    return None


def missing_main(address: str) -> StateRepoError:
    """Return the error to raise if a state repo has no main branch."""
    return StateRepoError(
        f"{address} has no branch '{MAIN_BRANCH}'; if it was renamed or deleted, restore it; if "
        "there is no state repo yet, push one made by `demandops init DIR`"
    )


def unopened(folder: Path, error: Exception) -> StateRepoError | None:
    """Return the error to raise if Git cannot open a folder; None if it is no Git repository."""
    if not ((folder / ".git").exists() or (folder / "HEAD").is_file()):
        return None
    return StateRepoError(
        f"{folder} is a Git repository that cannot be opened: {error}; if it belongs to another "
        f"user, run `git config --global --add safe.directory {folder.resolve()}`"
    )


def access_error(error: Exception, address: str, objects: Repository | None = None) -> Exception:
    """Return the error to raise if reading or writing ``address`` failed with ``error``.

    Only an error of the system or of libgit2 is replaced. Any other error is returned unchanged.
    With ``objects``, the text names the file and the commit of an object that cannot be read.
    """
    missing = isinstance(error, KeyError) and isinstance(error.args[0], Oid)
    if not (missing or isinstance(error, OSError | pygit2.GitError)):
        return error
    # the text of a KeyError would have quotes
    what = str(error.args[0]) if isinstance(error, KeyError) else str(error)
    if objects is not None and (name := _OBJECT.search(what)):
        place = trees.place_of(Repository(objects.path), Oid(hex=name[0]))
        what = f"{place}, Git object {name[0]}, is missing or damaged" if place else what
    return disk_error(error, address) or StateRepoError(
        f"{address} cannot be read: {what}; check its disk and its files with `git fsck`, then "
        "fetch or clone the missing files again, or restore them from a backup"
    )


@contextmanager
def reading(address: str, objects: Repository) -> Iterator[None]:
    """Raise StateRepoError if an object is missing or damaged; see :func:`access_error`."""
    try:
        yield
    except (pygit2.GitError, KeyError, OSError) as error:
        if getattr(error, "errno", None) is not None:  # not from libgit2, so about another file
            raise
        raise access_error(error, address, objects) from None


class StateRepository(ABC):
    """A state repo: Git objects to read and write, and a tip.

    :meth:`publish` only moves the tip forward. :meth:`refresh` may move it back, if somebody has
    rewritten main.
    """

    objects: Repository
    new: NewObjects
    """The new objects that are in memory and not on the disk yet."""
    address: str
    signer: Signer | None = None
    """Signs the commits that this process makes. If None, the commits are not signed."""
    runtime: Runtime = REAL
    """The clock, randomness and threads of the code that writes to the state repo."""
    while_waiting: Callable[[], object] = staticmethod(lambda: None)
    """Called again and again while this waits for git."""
    always_current: bool
    """Whether :meth:`tip` needs no fetch, as in a repository on this disk."""
    _tidying: subprocess.Popen[bytes] | None = None
    main_reference = MAIN
    """The reference of the tip: main, its remote-tracking branch, or HEAD of a checkout."""
    branches = "refs/heads/"
    """The prefix of the references of branches in this repository."""

    def tip(self) -> Oid:
        """Return the newest published commit that is known here, without asking the remote."""
        target = self.objects.references[self.main_reference].target
        assert isinstance(target, Oid)  # noqa: S101 - a branch points to a commit
        return target

    @abstractmethod
    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        """Fetch and return the newest published commit.

        Raises:
            Unavailable: git cannot fetch now.
            StateRepoError: the state repo has no main.
            FetchInterrupted: ``urgent`` returned true before the fetch ended.
        """

    @abstractmethod
    def publish(self, expected: Oid, commit: Oid) -> bool:
        """Make ``commit``, a descendant of ``expected``, the tip, durably, and return true.

        If the current tip is not ``expected``, or another writer holds the lock of main, change
        nothing and return false.

        Raises:
            Unavailable: the commit could not be published now, or the remote cannot be reached and
                nobody knows whether it got the commit. So look for the commit before you publish
                it again.
            PushDenied: the commit was not published, and another attempt would fail too.
            Unsound: the disk failed, and nobody knows whether the commit was published.
        """

    def write_anew(self, since: str) -> None:  # noqa: B027 - a remote confirms what it stored
        """Write the commits after ``since`` again, so that they are durable.

        With a remote, this does nothing. Raises Unavailable or Unsound if the write fails.
        """

    def reopened(self) -> Repository:
        """Return the repository opened again, for use in another thread.

        The result has no objects that are only in memory.
        """
        return Repository(self.objects.path)

    def includes(self, commit: str, other: str) -> bool:
        """Return whether ``commit`` is ``other`` or descends from ``other``.

        Return false if the two differ and either is unknown here. Any thread may call this method.
        """
        if commit == other:
            return True
        try:
            return self.reopened().descendant_of(commit, other)
        except (pygit2.GitError, KeyError, ValueError):
            return False

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        """Return whether ``path`` exists and is equal in two commits.

        Return false if either commit is unknown here.
        """
        found = self._trees(commit, other)
        if found is None:
            return False
        if path in ("", "."):
            return found[0].id == found[1].id
        return trees.entry(found[0], path) is not None and not trees.differ(*found, (path,))

    def changed_paths(self, since: str, commit: str) -> list[str] | None:
        """Return the paths of the files that differ between two commits, sorted.

        Return None if either commit is unknown here.
        """
        found = self._trees(since, commit)
        return None if found is None else sorted(path for path, _ in trees.differences(*found))

    def _trees(self, one: str, other: str) -> tuple[Tree, Tree] | None:
        objects = self.reopened()
        try:
            return trees.commit_of(objects, one).tree, trees.commit_of(objects, other).tree
        except StateRepoError:
            return None

    @abstractmethod
    def renew_if_damaged(self) -> bool:
        """Let git check the files, and replace a damaged clone; return whether it was replaced.

        Raises:
            Unavailable: the files are damaged and cannot be replaced now.
            StateRepoError: the files are damaged, and there is nothing to replace them from.
        """

    def abort(self) -> None:  # noqa: B027 - a repository on this disk has nothing to end
        """End the running transfer with a remote, if any; later ones raise RemoteAway."""

    def tidy(self) -> None:
        """Start git in the background to join the packs, unless it is still joining them."""
        if self._tidying is not None and self._tidying.poll() is None:
            return
        self._tidying = subprocess.Popen(
            ["git", *_REPACK],
            cwd=self.objects.path,
            env=os.environ | git_environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # so that Ctrl-C does not end it
        )
