"""The base class of state repos, on this disk or behind a URL, and the errors of both."""

from __future__ import annotations

import errno
import os
import re
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

import pygit2
from pygit2 import Oid, Repository, Tree

from demandops.base.errors import StateRepoError, Unsound
from demandops.base.runtime import REAL, Runtime
from demandops.base.settings import MAIN_BRANCH
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.repo.git import child_processes
from demandops.repo.git import tree as trees
from demandops.repo.git.objects import NewObjects
from demandops.repo.git.signing import Signer

MAIN = f"refs/heads/{MAIN_BRANCH}"
TIMEOUT_S = 120


class Unavailable(StateRepoError):
    """Raised when the state repo cannot be read or written now; demands stay in the journal."""

    def __init__(self, text: str, retry_after_s: float = 0.0) -> None:
        super().__init__(text)
        self.retry_after_s = retry_after_s  # what the server asks for


class RemoteAway(Unavailable):
    """Raised when the remote cannot be read, or nobody answers a push."""


class FetchInterrupted(StateRepoError):
    """Raised when a fetch was stopped for more urgent work, like a new demand."""


class PushDenied(StateRepoError):
    """Raised when a push fails although the remote can be read, or the disk permits no write.

    Whether the commits or the writer are refused, only further pushes show. Without a verdict of
    the server, such as over SSH, the connection may have failed.
    """

    def __init__(self, text: str, *, is_verdict: bool = True) -> None:
        super().__init__(text)
        self.is_verdict = is_verdict


_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NOT_ALLOWED = (errno.EACCES, errno.EPERM, errno.EROFS)
_BROKEN = (errno.EIO, errno.EUCLEAN, errno.ENODEV, errno.ENXIO, errno.ESTALE)
_NUMBERS = {os.strerror(number): number for number in (*_NO_ROOM, *_NOT_ALLOWED, *_BROKEN)}
_NUMBERS["failed to refresh packfiles"] = errno.EIO  # libgit2 could not list objects/pack


def disk_error(error: Exception, address: str) -> StateRepoError | Unsound | None:
    """Return the error to raise if ``error`` of a read or write came from the disk, else None."""
    number = getattr(error, "errno", None)
    if number is None:  # libgit2 gives the system's error only as text
        what = next((text for text in _NUMBERS if str(error).endswith(text)), "")
        number = _NUMBERS.get(what)
    else:
        what = os.strerror(number)
    if number in _NO_ROOM:
        return Unavailable(f"{address} cannot be written: its disk has no room ({what}); free some")
    if number == errno.EROFS:
        return PushDenied(f"{address} cannot be written: {what}; make its file system writable")
    if number in _NOT_ALLOWED:
        return PushDenied(
            f"{address} cannot be used: {what}; give the user of this program the right to read "
            "and write all files and folders there"
        )
    if number in _BROKEN:  # what is on the disk now is unknown, so the program must end
        return Unsound(f"{address} cannot be used: {what}; check its disk, then start again")
    return None


def missing_main(address: str) -> StateRepoError:
    return StateRepoError(
        f"{address} has no branch '{MAIN_BRANCH}'; if it was renamed or deleted, restore it; if "
        "there is no state repo yet, push one made by `demandops init DIR`"
    )


PARTIAL = (
    "{0} is a clone that was made with --filter and lacks objects; fetch them: "
    "git -C {0} fetch --refetch --no-filter origin"
)


def lacks_objects(repo: Repository) -> bool:
    # by what `git clone --filter` writes into the configuration
    filtered = (".promisor", ".partialclonefilter")
    return any(entry.name.endswith(filtered) for entry in repo.config)


def open_folder(folder: Path) -> Repository | None:
    """Open the Git repository of a folder; None if it has none."""
    try:
        repo = Repository(str(folder))
    except pygit2.GitError as error:
        if not ((folder / ".git").exists() or (folder / "HEAD").is_file()):
            return None
        raise StateRepoError(
            f"{folder} is a Git repository that cannot be opened: {error}; if it belongs to "
            f"another user, run `git config --global --add safe.directory {folder.resolve()}`"
        ) from None
    # libgit2 looks for a repository in the folders around it too
    here, around = folder.resolve(), Path(repo.workdir or repo.path).resolve()
    if here in (around, Path(repo.path).resolve()) or not here.is_relative_to(around):
        return repo
    path = here.relative_to(around)
    if repo.is_bare or repo.path_is_ignored(f"{path}/"):
        return None
    if (around / ROOT_FILE).is_file():
        raise StateRepoError(f"{folder} is a folder of the state repo {around}; name {around}")
    raise StateRepoError(
        f"{folder} is a folder of the Git repository {around}, but a state repo is a repository of "
        f"its own; make it one, for example with `git subtree split --prefix={path} -b fleet`"
    )


def access_error(error: Exception, address: str, objects: Repository | None = None) -> Exception:
    # An error that is neither of the system nor of libgit2 is returned unchanged. With ``objects``,
    # the text names the file and the commit of an object that cannot be read.
    is_missing = isinstance(error, KeyError) and isinstance(error.args[0], Oid)
    if not (is_missing or isinstance(error, OSError | pygit2.GitError)):
        return error
    what = f"Git object {error.args[0]} is missing" if is_missing else str(error)
    if objects is not None and not isinstance(error, OSError) and lacks_objects(objects):
        return StateRepoError(PARTIAL.format(address))
    if objects is not None and (oid := re.search("[0-9a-f]{40}", what)):
        place = trees.place_of(Repository(objects.path), Oid(hex=oid[0]))
        what = f"{place}, Git object {oid[0]}, is missing or damaged" if place else what
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
    # `publish` only moves the tip forward. `refresh` may move it back, if somebody has
    # rewritten main.

    objects: Repository
    new: NewObjects
    address: str
    signer: Signer | None = None
    runtime: Runtime = REAL
    # called again and again while this waits for git
    while_waiting: Callable[[], object] = staticmethod(lambda: None)
    always_current: bool  # whether the tip needs no fetch, as in a repository on this disk
    on_this_disk = False  # whether it costs nearly nothing to look for new commits
    _tidying: subprocess.Popen[bytes] | None = None
    # of the tip: main, its remote-tracking branch, or HEAD of a checkout
    main_reference = MAIN
    # the prefix of the references of branches
    branches = "refs/heads/"

    def tip(self) -> Oid:
        target = self.objects.references[self.main_reference].target
        assert isinstance(target, Oid)  # noqa: S101 - a branch points to a commit
        return target

    def list_references(self, *patterns: str) -> dict[str, str]:
        # name → commit; the patterns are those of ``git ls-remote``
        repo = Repository(self.objects.path)
        names = (n for n in repo.references if any(fnmatchcase(n, pattern) for pattern in patterns))
        # another process may delete a branch meanwhile, so a name may have no reference
        pairs = ((name, repo.references.get(name)) for name in names)
        return {name: str(reference.target) for name, reference in pairs if reference is not None}

    @abstractmethod
    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        """Fetch and return the newest published commit.

        If ``urgent`` returns true before the fetch ends, git is ended and FetchInterrupted is
        raised, so that a demand need not wait.
        """

    @abstractmethod
    def publish(self, expected: Oid, commit: Oid) -> bool:
        """Make ``commit``, a descendant of ``expected``, the tip, durably, and return true.

        If the current tip is not ``expected``, or another writer holds the lock of main, change
        nothing and return false. After Unavailable, nobody knows whether the remote got the commit,
        so look for it before you publish it again. After PushDenied, it is not published.
        """

    def write_anew(self, since: str) -> None:  # noqa: B027 - a remote confirms what it stored
        """Write the commits after ``since`` again, so that they are durable."""

    def reopened(self) -> Repository:
        # two threads must not use one Repository; this one has no objects that are only in memory
        return Repository(self.objects.path)

    def includes(self, commit: str, other: str) -> bool:
        """Return whether ``commit`` is ``other`` or descends from it, as far as known here."""
        if commit == other:
            return True
        try:
            return self.reopened().descendant_of(commit, other)
        except (pygit2.GitError, KeyError, ValueError):
            return False

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        pair = self._trees(commit, other)
        if pair is None:
            return False
        if path in ("", "."):
            return pair[0].id == pair[1].id
        return trees.entry(pair[0], path) is not None and not trees.differ(*pair, (path,))

    def changed_paths(self, since: str, commit: str) -> list[str] | None:
        pair = self._trees(since, commit)
        return None if pair is None else sorted(path for path, _ in trees.differences(*pair))

    def _trees(self, commit: str, other: str) -> tuple[Tree, Tree] | None:
        objects = self.reopened()
        try:
            return trees.commit_of(objects, commit).tree, trees.commit_of(objects, other).tree
        except StateRepoError:
            return None

    def renew_if_damaged(self) -> bool:
        """Let git check a clone, and replace a damaged one; return whether it was replaced."""
        return False

    def abort(self) -> None:  # noqa: B027 - a repository on this disk has nothing to end
        """End the running transfer with a remote, if any; later ones raise RemoteAway."""

    def tidy(self) -> None:
        """Start git in the background to join the packs, unless it is still joining them."""
        if self._tidying is not None and self._tidying.poll() is None:
            return
        self._tidying = subprocess.Popen(
            # --geometric joins a pack only with those of about its size, so that a demand's small
            # pack does not let git write the whole history again
            [
                *child_processes.git(self.objects.path),
                "repack",
                "--geometric=2",
                "-d",
                "-l",
                "--quiet",
            ],
            env=os.environ | child_processes.git_environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # so that Ctrl-C does not end it
        )
