"""State repos on this disk, and how the repo at an address is opened."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pygit2
from pygit2 import Oid, Repository

from demandops.base.addresses import holds_secret
from demandops.base.errors import StateRepoError, Unsound
from demandops.base.quoting import quoted
from demandops.base.settings import MAIN_BRANCH
from demandops.repo.git import repository as repositories
from demandops.repo.git.objects import NewObjects, sync_folder
from demandops.repo.git.remote_repository import Notify, RemoteRepository
from demandops.repo.git.repository import PushDenied, StateRepository, Unavailable

# ---- a bare repository on this disk ----

# From this age on, a branch's lock counts as left behind by a killed process: Git locks a branch
# only for milliseconds.
_STALE_LOCK_S = 5.0

log = logging.getLogger("demandops")


class LocalRepository(StateRepository):
    """A repository on this disk, written in place and fsynced; nobody may have main checked out."""

    always_current = on_this_disk = True

    def __init__(self, path: Path) -> None:
        self.address = str(path)
        self._lock_seen: tuple[tuple[int, int], float] | None = None
        objects = repositories.open_folder(path)
        if objects is None:
            raise StateRepoError(
                f"{path} is not a Git repository; name another folder, or make one in a new folder "
                "with `demandops init DIR --bare`"
            )
        self.objects = objects
        self.new = NewObjects(self.objects)
        try:
            self._require_usable(path)
            _ = self.objects[self.tip()].peel(pygit2.Commit).tree
        except (pygit2.GitError, KeyError, OSError) as error:
            raise repositories.access_error(error, self.address, self.objects) from None

    def _require_usable(self, path: Path) -> None:
        borrowed = Path(self.objects.path) / "objects" / "info" / "alternates"
        if borrowed.exists():
            raise StateRepoError(
                f"{path} borrows objects of another repository, which may remove them; copy them "
                f"with `git -C {path} repack -a -d`, then remove {borrowed}"
            )
        self.new.clean()
        self.tip()
        if self.objects.is_shallow or repositories.lacks_objects(self.objects):
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
            raise repositories.missing_main(self.address)
        if not isinstance(main.target, Oid):
            raise StateRepoError(
                f"the branch '{MAIN_BRANCH}' of {self.address} is only another name of "
                f"{main.target}; make it a branch: git -C {self.address} update-ref --no-deref "
                f"{repositories.MAIN} {main.target}"
            )
        return main.target

    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        return self.tip()

    def publish(self, expected: Oid, commit: Oid) -> bool:
        if self.tip() != expected:
            return False
        if needs_push(self.objects.path):
            raise Unavailable(
                f"{self.address} got hooks or settings that only `git push` obeys; start again to "
                "use it"
            )
        # libgit2 moves a branch only from where this reading has found it
        reference = self.objects.references[repositories.MAIN]
        if reference.target != expected:
            return False
        try:
            with self.new.packed(commit):
                reference.set_target(commit, "demandops")
        except (pygit2.GitError, OSError) as error:
            reason = repositories.disk_error(error, self.address)
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
        branch = Path(self.objects.path) / repositories.MAIN
        lock = branch.with_name(f"{branch.name}.lock")
        try:
            with self.new.packed_anew(self.tip(), since), lock.open("x") as file:
                file.write(f"{self.tip()}\n")
                file.flush()
                os.fsync(file.fileno())
                lock.replace(branch)
                sync_folder(branch.parent)
        except (pygit2.GitError, OSError) as error:
            self._break_stale_lock()
            reason = repositories.disk_error(error, self.address)
            # PushDenied would be wrong, because the commits are on main
            if not isinstance(reason, Unsound | Unavailable):
                reason = Unavailable(str(reason or f"{self.address} cannot be written: {error}"))
            raise reason from None

    def _break_stale_lock(self) -> None:
        # its age counts from when this process first saw it, by the monotonic clock
        lock = Path(self.objects.path) / f"{repositories.MAIN}.lock"
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


# ---- a bare repository on this disk that only git can write as its owner wants ----

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


class PushedRepository(RemoteRepository):
    on_this_disk = True

    def __init__(self, place: LocalRepository, folder: Path, notify: Notify) -> None:
        self._place = place
        super().__init__(str(Path(place.objects.path).resolve()), folder, notify, False)

    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        # to look is cheap, to fetch is not; git says why the repository cannot be read
        with suppress(pygit2.GitError, KeyError, OSError, StateRepoError):
            if self._place.tip() == self.tip():
                return self.tip()
        return super().refresh(urgent)

    def tidy(self) -> None:
        super().tidy()
        self._place.tidy()


# ---- what is only read: a person's checkout, and the last fetch of a URL ----


def is_checkout(folder: Path) -> bool:
    return (folder / ".git").exists() and (folder / "demandops.yaml").is_file()


def checkout_around(folder: Path) -> Path | None:
    return next(filter(is_checkout, (folder, *folder.parents)), None)


def origin_of(checkout: Path) -> str | None:
    try:
        remotes = {remote.name: remote.url for remote in Repository(str(checkout)).remotes}
    except pygit2.GitError:
        return None
    return remotes.get("origin")


class Checkout(LocalRepository):
    """A checkout: its tip is the commit that is checked out, on any branch."""

    main_reference = "HEAD"
    branches = "refs/remotes/origin/"

    def tip(self) -> Oid:
        target = self.objects.head.target
        assert isinstance(target, Oid)  # noqa: S101 - HEAD is resolved
        return target

    def _require_usable(self, path: Path) -> None:
        if self.objects.is_empty or self.objects.head_is_unborn:
            raise StateRepoError(f"{path} has no commit yet; commit its files first")

    def publish(self, expected: Oid, commit: Oid) -> bool:
        # a person may be editing the files, and would commit back what a demand has changed
        raise PushDenied(
            f"{self.address} is a checkout, and no command writes to a checkout; name the "
            "checkout's remote instead"
        )


class LastFetch(LocalRepository):
    """The clone of a URL at its last fetch, for readers that must not wait for the network."""

    main_reference = f"refs/remotes/origin/{MAIN_BRANCH}"
    branches = "refs/remotes/origin/"

    def _require_usable(self, path: Path) -> None:
        pass  # the process that made the clone has checked it


# ---- addresses: a folder, or a URL that Git can clone ----

_SCHEME = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]*)(://|::)")
_SCP = re.compile(r"^([^/\s:]+:(?!:)|[^/\s:]+@\[[^\]/]+\]:)")
_NO_HOST = re.compile(r"^(https?|ssh|git|git\+ssh)://([^/@]*@)?(:\d*)?(/|$)")
_ALLOWED = ("https", "http", "ssh", "git", "file", "git+ssh")


def is_url(address: str) -> bool:
    try:
        exists = Path(address).exists()
    except OSError:  # the address is too long, or in a folder that this user cannot read
        exists = False
    # like git, which takes an existing folder ``a:b`` for a folder
    return not exists and bool(_SCHEME.match(address) or _SCP.match(address))


def connect(
    address: str,
    folder: Path,
    notify: Notify = lambda text: None,
    *,
    allow_offline: bool = False,
    only_read: bool = False,
) -> StateRepository:
    """Return the state repo at an address: a URL, or a folder where main is not checked out.

    The clone of what is pushed to is made in ``folder``; with ``allow_offline``, an existing one is
    used if its remote is away. With ``only_read``, the address may also be that of a checkout.
    """
    if is_url(address):
        _check_url(address)
        return RemoteRepository(address, folder / "clone.git", notify, allow_offline)
    try:
        path = Path(address).expanduser()
        is_folder, exists = path.is_dir(), path.exists()
        is_read_only = is_checkout(path) and only_read
    except (OSError, ValueError, RuntimeError) as error:  # for example ``~x`` without a user x
        reason = getattr(error, "strerror", None) or str(error)
        raise StateRepoError(
            f"{quoted(address)} cannot be opened: {reason}; name the folder of a state repo"
        ) from None
    if exists and not is_folder:
        raise StateRepoError(f"{address} is not a folder; name the folder of a state repo")
    if not is_folder:
        place = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise StateRepoError(
            f"{address} does not exist{place}; correct the path, or make a state repo there with "
            f"`demandops init {address} --bare`"
        )
    if is_read_only:
        return Checkout(path)
    repository = LocalRepository(path)
    if only_read or not needs_push(address):
        return repository
    return PushedRepository(repository, folder / "clone.git", notify)


def _check_url(url: str) -> None:
    scheme = _SCHEME.match(url)
    # git would start a program for other schemes: ``ext::COMMAND``, or git-remote-SCHEME
    if scheme and (scheme[2] == "::" or scheme[1] not in _ALLOWED):
        raise StateRepoError(
            f"a state repo's address cannot start with '{scheme[0]}'; use https, ssh, git or file"
        )
    if holds_secret(url):
        raise StateRepoError(
            "the state repo's address holds a password or token, which process lists would show; "
            "remove it and use a credential helper, ~/.netrc or an SSH key"
        )
    if no_host := _NO_HOST.match(url):
        raise StateRepoError(
            f"the state repo's address names no host after '{no_host[1]}://'; write "
            f"{no_host[1]}://HOST/PATH, or the folder of a bare repository"
        )
