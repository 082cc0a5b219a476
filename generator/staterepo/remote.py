"""Where the state repo is: a bare repository on this disk, or anything that Git can clone.

Both give a pygit2 repository to read and write objects in and one way to publish a commit, which
succeeds only on top of what was there: never a forced push, never a merge of texts.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import git
import pygit2
from pygit2 import Oid, Repository

from generator.errors import StateRepoError
from generator.settings import MAIN_BRANCH

_MAIN = f"refs/heads/{MAIN_BRANCH}"
_REMOTE_MAIN = f"refs/remotes/origin/{MAIN_BRANCH}"
_SCHEME = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]*)(://|::)")
_SCP = re.compile(r"^([^/\s:]+:(?!:)|[^/\s:]+@\[[^\]/]+\]:)")
_ALLOWED = ("https", "http", "ssh", "git", "file", "git+ssh")
_HAS_PASSWORD = re.compile(r"(://)[^/@\s]*:(?!\d+/)\S*@")
_USER = re.compile(r"(://)[^/@\s]*@")
_BEHIND = re.compile(r"\[rejected\]")
_REMOTE_SAYS = re.compile(r"remote: ?(.*)")
_REFUSED = re.compile(r"\[remote rejected\] \((.*)\)")
_PASSING = re.compile(r"lock|failed to update ref|incorrect old value")
_NO_RIGHT = re.compile(r"returned error: 40[13]|Permission denied|access denied", re.IGNORECASE)
_TIMEOUT_S = 120
_STALE_LOCK_S = 5.0
_ENVIRONMENT = {"GIT_TERMINAL_PROMPT": "0", "LC_ALL": "C"}

Say = Callable[[str], None]

log = logging.getLogger("demandops")


class RemoteAway(StateRepoError):
    """The remote did not answer; what is kept in the outbox goes there when it is back."""


class PushDenied(StateRepoError):
    """The remote answers and takes no push (a hook, a protected branch, missing rights)."""


def without_secrets(text: str) -> str:
    """Return ``text`` with the user part of every URL taken out: it may hold a password."""
    return _USER.sub(r"\1", _HAS_PASSWORD.sub(r"\1", text))


class StateRepository(ABC):
    """A state repo: objects to read and write, and a tip that moves forward only."""

    objects: Repository
    address: str

    @abstractmethod
    def tip(self) -> Oid:
        """Return the newest published commit that is known here, without asking anybody."""

    @abstractmethod
    def refresh(self) -> Oid:
        """Ask where the state repo is now and return its newest commit.

        Raises:
            RemoteAway: where it cannot be reached.
        """

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

    def give_up(self) -> None:  # noqa: B027 - a repository on this disk has nothing to end
        """End what is under way with a remote; nothing where there is none."""

    def tidy(self) -> None:
        """Let git pack loose objects, if there are many; it does so in a process of its own."""
        with suppress(git.GitCommandError), git.Repo(self.objects.path) as repo:
            _git(repo, "gc", "--auto", "--quiet")

    @property
    @abstractmethod
    def always_current(self) -> bool:
        """Tell whether :meth:`tip` can never be behind (a repository on this disk)."""


class EmbeddedRepository(StateRepository):
    """A bare repository on this disk, written in place and fsynced."""

    def __init__(self, path: Path) -> None:
        self.address = str(path)
        try:
            self.objects = Repository(str(path))
        except pygit2.GitError:
            raise StateRepoError(
                f"{path} is no Git repository; make one with `demandops init {path} --bare`"
            ) from None
        if not self.objects.is_bare:
            _refuse_checked_out(path)
        if _MAIN not in self.objects.references:
            raise StateRepoError(
                f"{path} has no branch '{MAIN_BRANCH}'; make a state repo with "
                "`demandops init DIR --bare`"
            )

    def tip(self) -> Oid:
        """Return the branch's commit, read anew: others may write here too."""
        target = self.objects.references[_MAIN].target
        assert isinstance(target, Oid)  # noqa: S101 - a branch points to a commit
        return target

    def refresh(self) -> Oid:
        """Return the tip; it is never behind."""
        return self.tip()

    def publish(self, expected: Oid, commit: Oid) -> bool:
        """Move the branch if it still is at ``expected`` (checked under Git's own lock)."""
        reference = self.objects.references[_MAIN]
        if reference.target != expected:
            return False
        try:
            reference.set_target(commit, "demandops")
        except (pygit2.GitError, OSError):
            self._break_stale_lock()
            return False  # another writer holds the lock or was first: judge anew
        return True

    def _break_stale_lock(self) -> None:
        """Remove a branch's lock that a killed process left: Git holds one for milliseconds."""
        lock = Path(self.objects.path) / f"{_MAIN}.lock"
        with suppress(FileNotFoundError):
            if time.time() - lock.stat().st_mtime > _STALE_LOCK_S:
                log.warning("removing %s, which a killed process left behind", lock)
                lock.unlink()

    @property
    def always_current(self) -> bool:
        """Say yes: there is no copy that could be behind."""
        return True


def _refuse_checked_out(path: Path) -> None:
    with git.Repo(path) as repo:
        heads = [
            line.removeprefix("branch ")
            for line in repo.git.worktree("list", "--porcelain").splitlines()
            if line.startswith("branch ")
        ]
    if _MAIN in heads:
        raise StateRepoError(
            f"{path} has '{MAIN_BRANCH}' checked out, and its files would fall behind the commits; "
            f"use a bare clone: git clone --bare {path} {path}.git"
        )


class ClonedRepository(StateRepository):
    """A bare clone of a remote; clone, fetch and push run git itself, with the user's set-up."""

    def __init__(self, url: str, folder: Path, say: Say, patient: bool) -> None:
        self.address = without_secrets(url)
        self._url = url
        self._folder = folder
        self._given_up = False
        self._talking: subprocess.Popen[bytes] | None = None
        for lock in folder.rglob("*.lock"):  # the folder is ours alone: a killed process left it
            lock.unlink(missing_ok=True)
        if not self._is_sound():
            self._clone(say)
        self._git = git.Repo(folder)
        self.objects = Repository(str(folder))
        try:
            self.refresh()
        except RemoteAway as error:
            if not patient:
                raise
            log.warning("%s; going on from what was fetched last", error)

    def _is_sound(self) -> bool:
        """Tell whether the clone of an earlier run can be used (a crash may have cut it off)."""
        try:
            repo = Repository(str(self._folder))
            target = repo.references[_REMOTE_MAIN].target
            return isinstance(repo[target], pygit2.Commit)
        except (pygit2.GitError, KeyError):
            return False

    def _clone(self, say: Say) -> None:
        say(f"cloning {self.address}")
        if self._folder.exists():
            shutil.rmtree(self._folder)
        self._folder.parent.mkdir(parents=True, exist_ok=True)
        partial = self._folder.with_name(self._folder.name + ".partial")
        shutil.rmtree(partial, ignore_errors=True)
        with git.Repo.init(partial, bare=True) as repo:
            with repo.config_writer() as config:
                config.set_value('remote "origin"', "url", self._url)
            partial.joinpath("config").chmod(0o600)
            self._fetch(repo)
        partial.rename(self._folder)

    def _fetch(self, repo: git.Repo) -> None:
        try:
            # told here, not configured: a push that outlives a killed generator moves nothing here
            spec = f"+{_MAIN}:{_REMOTE_MAIN}"
            self._talk(repo, "fetch", "--no-tags", "--quiet", "origin", spec)
        except git.GitCommandError as error:
            text = without_secrets(str(error.stderr))
            if "couldn't find remote ref" in text:
                raise StateRepoError(
                    f"{self.address} has no branch '{MAIN_BRANCH}'; push one made by "
                    "`demandops init DIR`"
                ) from None
            raise RemoteAway(f"{self.address} cannot be fetched: {_last_line(text)}") from None

    def tip(self) -> Oid:
        """Return the remote's commit as of the last fetch or push."""
        target = self.objects.references[_REMOTE_MAIN].target
        assert isinstance(target, Oid)  # noqa: S101 - a branch points to a commit
        return target

    def refresh(self) -> Oid:
        """Fetch and return the remote's commit."""
        self._fetch(self._git)
        return self.tip()

    def publish(self, expected: Oid, commit: Oid) -> bool:
        """Push ``commit``; the remote takes it only on top of what it has."""
        try:
            lease = f"--force-with-lease={_MAIN}:{expected}"  # forces nothing: commit is on top
            spec = f"{commit}:{_MAIN}"
            self._talk(self._git, "push", "--porcelain", "--quiet", lease, "origin", spec)
        except git.GitCommandError as error:
            text = without_secrets(f"{error.stdout}\n{error.stderr}")
            tip = self.refresh()
            if tip == commit or self.objects.descendant_of(tip, commit):
                return True  # it was taken, and the answer got lost
            if tip != expected or _BEHIND.search(text):
                return False
            raise self._why_not(text) from None
        self.objects.references.create(_REMOTE_MAIN, commit, force=True)
        return True

    def _talk(self, repo: git.Repo, *command: str) -> None:
        if self._given_up:
            raise RemoteAway(f"{self.address} was given up")
        with repo.git.custom_environment(**_ENVIRONMENT):
            guard = repo.git.execute(  # kept: it ends the process when it goes
                [repo.git.GIT_PYTHON_GIT_EXECUTABLE, *command],
                as_process=True,
                start_new_session=True,
            )
        process = guard.proc
        assert process is not None  # noqa: S101 - it was started just now
        self._talking = process
        if self._given_up:  # between the first look and now
            self.give_up()
        try:
            out, err = process.communicate(timeout=_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, err = process.communicate()
        finally:
            self._talking = None
        if process.returncode:
            raise git.GitCommandError(list(command), process.returncode, err, out)

    def give_up(self) -> None:
        """End what git is waiting for, and start nothing more."""
        self._given_up = True
        process = self._talking
        if process is not None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)

    def _why_not(self, text: str) -> StateRepoError:
        """Tell a push that can be tried again from one that is denied."""
        refused = _REFUSED.search(text)
        if refused and not _PASSING.search(refused[1]):
            said = " ".join(line.strip(" '") for line in _REMOTE_SAYS.findall(text)).strip()
            reason = f"{refused[1]}: {said}" if said else refused[1]
            return PushDenied(f"{self.address} takes no push: {reason}")
        if _NO_RIGHT.search(text):
            return PushDenied(f"{self.address} takes no push: {_last_line(text)}")
        reason = refused[1] if refused else _last_line(text)
        return RemoteAway(f"{self.address} cannot be pushed to: {reason}")

    @property
    def always_current(self) -> bool:
        """Say no: the remote may have moved since the last fetch."""
        return False


def _git(repo: git.Repo, *command: str) -> None:
    """Run a git command that talks to the remote.

    In a session of its own: Ctrl-C goes to every process of the terminal, and must not cut off a
    push that the generator is waiting for.
    """
    with repo.git.custom_environment(**_ENVIRONMENT):
        repo.git.execute(
            [repo.git.GIT_PYTHON_GIT_EXECUTABLE, *command],
            kill_after_timeout=_TIMEOUT_S,
            start_new_session=True,
        )


def _last_line(text: str) -> str:
    lines = [line.strip(" '\"") for line in text.splitlines() if line.strip(" '\"")]
    fatal = [line for line in lines if line.startswith(("fatal:", "error:", "remote:", "!"))]
    return (fatal or lines or ["git gave no reason"])[-1]


def is_url(address: str) -> bool:
    """Tell a Git URL (``https://…``, ``ssh://…``, ``user@host:path``) from a folder."""
    return not Path(address).exists() and bool(_SCHEME.match(address) or _SCP.match(address))


def _check_url(url: str) -> None:
    scheme = _SCHEME.match(url)
    if scheme and (scheme[2] == "::" or scheme[1] not in _ALLOWED):
        raise StateRepoError(
            f"'{scheme[0]}' is no way to reach a state repo; use https, ssh, git or file"
        )
    if _HAS_PASSWORD.search(url):
        raise StateRepoError(
            "the state repo's address holds a password, which process lists would show; leave "
            "it out and give it to git by a credential helper, ~/.netrc or an SSH key"
        )


def connect(
    address: str, folder: Path, say: Say = lambda text: None, *, patient: bool = False
) -> StateRepository:
    """Open the state repo at ``address``.

    Args:
        address: a folder with a bare repository, or any URL that git clones.
        folder: where the clone of a URL is kept.
        say: told about work that takes a while.
        patient: whether a clone that is here already will do where its remote is away.

    Raises:
        StateRepoError: saying what is wrong with the address and how to mend it.
    """
    if is_url(address):
        _check_url(address)
        return ClonedRepository(address, folder / "clone.git", say, patient)
    path = Path(address).expanduser()
    if not path.is_dir():
        raise StateRepoError(
            f"{address} does not exist; make a state repo with `demandops init {address} --bare`"
        )
    return EmbeddedRepository(path)
