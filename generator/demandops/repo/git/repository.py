"""State repos on this disk, what is only read of one, and the errors of all state repos."""

from __future__ import annotations

import errno
import os
import re
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path

import pygit2
from pygit2 import Oid, Repository, Tree

from demandops.base.errors import StateRepoError, Unsound
from demandops.base.runtime import REAL, Runtime, log
from demandops.base.settings import MAIN_BRANCH
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.repo.git import child_processes
from demandops.repo.git import tree as trees
from demandops.repo.git.objects import NewObjects, sync_folder
from demandops.repo.git.signing import Signer

MAIN = f"refs/heads/{MAIN_BRANCH}"
TIMEOUT_S = 120
# From this age on, a branch's lock counts as left behind by a killed process: Git locks a branch
# only for milliseconds.
_STALE_LOCK_S = 5.0


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
def using(address: str, objects: Repository | None = None) -> Iterator[None]:
    # any error then names the address; `reading` is for errors of the objects alone
    try:
        yield
    except Exception as error:
        raise access_error(error, address, objects) from None


@contextmanager
def reading(address: str, objects: Repository) -> Iterator[None]:
    """Raise StateRepoError if an object is missing or damaged; see :func:`access_error`."""
    try:
        yield
    except (pygit2.GitError, KeyError, OSError) as error:
        if getattr(error, "errno", None) is not None:  # not from libgit2, so about another file
            raise
        raise access_error(error, address, objects) from None


# ---- whether only git can write a repository on this disk as its owner wants ----

_HOOKS = ("pre-receive", "update", "post-receive", "post-update", "reference-transaction")
# What a push may do, and who may read what it writes. The objects that this program makes would
# pass git's check of objects, and it always keeps them packed.
_SETTINGS = re.compile(
    r"core\.sharedrepository|transfer\.hiderefs|hook\..*|receive\.(?!fsckobjects$|unpacklimit$).*"
)


def needs_push(address: str) -> bool:
    """Return whether a folder has a repository with hooks or settings that only git obeys."""
    try:
        repo = Repository(os.path.expanduser(address))  # noqa: PTH111 - the other one raises errors
        settings = {entry.name.lower(): entry.value or "" for entry in repo.config}
    except (pygit2.GitError, ValueError):
        return False
    hooks = Path(repo.path, os.path.expanduser(settings.get("core.hookspath", "hooks")))  # noqa: PTH111
    return any(map(_SETTINGS.fullmatch, settings)) or any(
        (hooks / name).is_file() and os.access(hooks / name, os.X_OK) for name in _HOOKS
    )


# ---- a bare repository on this disk ----


class StateRepository:
    """A bare repository on this disk, written in place and fsynced; nobody has main checked out.

    Its subclass :class:`remote_repository.RemoteRepository` is behind a URL. `publish` only moves
    the tip forward. `refresh` may move it back, if somebody has rewritten main.
    """

    signer: Signer | None = None
    runtime: Runtime = REAL
    # called again and again while this waits for git
    while_waiting: Callable[[], object] = staticmethod(lambda: None)
    always_current = True  # whether the tip needs no fetch
    on_this_disk = True  # whether it costs nearly nothing to look for new commits
    # of the tip: main, its remote-tracking branch, or HEAD of a checkout
    main_reference = MAIN
    _tidying: subprocess.Popen[bytes] | None = None
    _lock_seen: tuple[tuple[int, int], float] | None = None

    def __init__(self, path: Path) -> None:
        self.address = str(path)
        objects = open_folder(path)
        if objects is None:
            raise StateRepoError(
                f"{path} is not a Git repository; name another folder, or make one in a new folder "
                "with `demandops init DIR --bare`"
            )
        self.objects, self.new = objects, NewObjects(objects)
        with using(self.address, objects):
            self._require_usable(path)
            _ = self.objects[self.tip()].peel(pygit2.Commit).tree

    def _require_usable(self, path: Path) -> None:
        borrowed = Path(self.objects.path) / "objects" / "info" / "alternates"
        if borrowed.exists():
            raise StateRepoError(
                f"{path} borrows objects of another repository, which may remove them; copy them "
                f"with `git -C {path} repack -a -d`, then remove {borrowed}"
            )
        self.new.clean()
        self.tip()
        if self.objects.is_shallow or lacks_objects(self.objects):
            raise StateRepoError(
                f"{path} is a clone that lacks a part of the history or of the files; clone the "
                "state repo again, without --depth and --filter"
            )
        if self.objects.branches.local[MAIN_BRANCH].is_checked_out():
            raise StateRepoError(
                f"{path} has '{MAIN_BRANCH}' checked out, so its files would become outdated; "
                f"use a bare clone: git clone --bare {path} {path}.git"
            )

    def tip(self) -> Oid:
        main = self.objects.references.get(self.main_reference)
        if main is None:
            raise missing_main(self.address)
        if not isinstance(main.target, Oid):
            raise StateRepoError(
                f"the branch '{MAIN_BRANCH}' of {self.address} is only another name of "
                f"{main.target}; make it a branch: git -C {self.address} update-ref --no-deref "
                f"{MAIN} {main.target}"
            )
        return main.target

    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        """Fetch and return the newest published commit.

        If ``urgent`` returns true before the fetch ends, git is ended and FetchInterrupted is
        raised, so that a demand need not wait.
        """
        return self.tip()

    def publish(self, expected: Oid, commit: Oid) -> bool:
        """Make ``commit``, a descendant of ``expected``, the tip, durably, and return true.

        If the current tip is not ``expected``, or another writer holds the lock of main, change
        nothing and return false. After Unavailable, nobody knows whether the remote got the commit,
        so look for it before you publish it again. After PushDenied, it is not published.
        """
        if self.tip() != expected:
            return False
        if needs_push(self.objects.path):
            raise Unavailable(
                f"{self.address} got hooks or settings that only `git push` obeys; start again to "
                "use it"
            )
        # libgit2 moves a branch only from where this reading has found it
        reference = self.objects.references[MAIN]
        if reference.target != expected:
            return False
        try:
            with self.new.packed(commit):
                reference.set_target(commit, "demandops")
        except (pygit2.GitError, OSError) as error:
            reason = disk_error(error, self.address)
            if isinstance(reason, PushDenied) and self.tip() != expected:
                return False  # even if the new tip is ``commit``: it may not be synced
            if reason is not None:
                raise reason from None
            self._break_stale_lock()
            if self._lock_seen is None and self.tip() == expected:
                raise Unavailable(f"{self.address} cannot be written: {error}") from None
            return False  # another writer holds the lock or was first; the caller tries again
        return True

    def write_anew(self, since: str) -> None:
        """Write the commits after ``since`` again, so that they are durable."""
        branch = Path(self.objects.path) / MAIN
        lock = branch.with_name(f"{branch.name}.lock")
        try:
            self.new.read_again(self.tip(), since)
            with self.new.packed(self.tip()), lock.open("x") as file:
                file.write(f"{self.tip()}\n")
                file.flush()
                os.fsync(file.fileno())
                lock.replace(branch)
                sync_folder(branch.parent)
        except (pygit2.GitError, OSError) as error:
            self._break_stale_lock()
            reason = disk_error(error, self.address)
            # PushDenied would be wrong, because the commits are on main
            if not isinstance(reason, Unsound | Unavailable):
                reason = Unavailable(str(reason or f"{self.address} cannot be written: {error}"))
            raise reason from None

    def _break_stale_lock(self) -> None:
        # its age counts from when this process first saw it, by the monotonic clock
        lock = Path(self.objects.path) / f"{MAIN}.lock"
        try:
            status = lock.lstat()
        except FileNotFoundError:
            self._lock_seen = None
            return
        identity, now = (status.st_ino, status.st_mtime_ns), self.runtime.monotonic()
        if self._lock_seen is None or self._lock_seen[0] != identity:
            self._lock_seen = (identity, now)
        elif now - self._lock_seen[1] > _STALE_LOCK_S:
            log.warning("removing %s, which a killed process left behind", lock)
            try:
                lock.unlink()
            except OSError as error:
                raise Unavailable(
                    f"{self.address} cannot be written: {lock} cannot be removed "
                    f"({error.strerror}); remove it"
                ) from None

    def list_references(self, *patterns: str) -> dict[str, str]:
        # name → commit; the patterns are those of ``git ls-remote``
        repo = Repository(self.objects.path)
        names = (n for n in repo.references if any(fnmatchcase(n, pattern) for pattern in patterns))
        # another process may delete a branch meanwhile, so a name may have no reference
        pairs = ((name, repo.references.get(name)) for name in names)
        return {name: str(reference.target) for name, reference in pairs if reference is not None}

    def reopened(self) -> Repository:
        # two threads must not use one Repository; this one has no objects that are only in memory
        return Repository(self.objects.path)

    def includes(self, commit: str, other: str) -> bool:
        with suppress(pygit2.GitError):  # a damaged clone is being made anew
            return commit == other or trees.includes(self.reopened(), commit, other)
        return False

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        with suppress(StateRepoError):
            new, old = self._trees(commit, other)
            if path in ("", "."):
                return new.id == old.id
            return trees.entry(new, path) is not None and not trees.differ(new, old, (path,))
        return False

    def changed_paths(self, since: str, commit: str) -> list[str] | None:
        with suppress(StateRepoError):
            return sorted(path for path, _ in trees.differences(*self._trees(since, commit)))
        return None

    def _trees(self, commit: str, other: str) -> tuple[Tree, Tree]:
        objects = self.reopened()
        return trees.commit_of(objects, commit).tree, trees.commit_of(objects, other).tree

    def renew_if_damaged(self) -> bool:
        """Let git check a clone, and replace a damaged one; return whether it was replaced."""
        return False

    def abort(self) -> None:
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
                *("repack", "--geometric=2", "-d", "-l", "--quiet"),
            ],
            env=os.environ | child_processes.git_environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # so that Ctrl-C does not end it
        )


# ---- what is only read: a person's checkout, and the last fetch of a URL ----


class Checkout(StateRepository):
    """A checkout: its tip is the commit that is checked out, on any branch."""

    main_reference = "HEAD"

    def tip(self) -> Oid:
        target = self.objects.head.target
        assert isinstance(target, Oid)  # noqa: S101 - HEAD is resolved
        return target

    def _require_usable(self, path: Path) -> None:
        if self.objects.is_empty or self.objects.head_is_unborn:
            raise StateRepoError(f"{path} has no commit yet; commit its files first")


class LastFetch(StateRepository):
    """The clone of a URL at its last fetch, for readers that must not wait for the network."""

    main_reference = f"refs/remotes/origin/{MAIN_BRANCH}"

    def _require_usable(self, path: Path) -> None:
        pass  # the process that made the clone has checked it
