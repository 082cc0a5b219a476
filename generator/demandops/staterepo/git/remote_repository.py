"""The state repo behind a URL: a bare clone, fetched and pushed by git, and why that failed."""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import git
import pygit2
from pygit2 import Oid, Repository

from demandops.errors import StateRepoError
from demandops.runtime import REAL
from demandops.settings import MAIN_BRANCH
from demandops.staterepo.git.new_objects import NewObjects
from demandops.staterepo.git.repository import (
    ENVIRONMENT,
    MAIN,
    TIMEOUT_S,
    DiskFull,
    FetchInterrupted,
    PushDenied,
    RemoteAway,
    StateRepository,
)

_REMOTE_MAIN = f"refs/remotes/origin/{MAIN_BRANCH}"
_REMOTE_MOVED = re.compile(r"\[rejected\]")
_REMOTE_MESSAGE = re.compile(r"remote: ?(.*)")
_REMOTE_REJECTED = re.compile(r"\[remote rejected\] \((.*)\)")
_TEMPORARY = re.compile(r"lock|failed to update ref|incorrect old value")
_POLL_S = 0.02
_CLONE_TIMEOUT_S = 3600
"""The limit of a first clone; git ends a connection that carries nothing much earlier."""
_NO_ROOM = re.compile(r"^(?!remote:).*No space left on device", re.MULTILINE)
_NO_PERMISSION = re.compile(
    r"returned error: 40[13]|Permission denied|access denied", re.IGNORECASE
)

_USER = re.compile(r"(://)[^/@\s]*@")

HAS_PASSWORD = re.compile(r"(://)[^/@\s]*:(?!\d+/)\S*@")
HAS_TOKEN = re.compile(
    r"^https?://(gh[a-z]_|github_pat_|gl[a-z]+-|ATBB|ATCTT|(?=[a-zA-Z]*\d)[a-zA-Z0-9]{32,}@)", re.I
)
"""Matches a URL whose user name is a token. Other user names are normal: some forges need one."""
Notify = Callable[[str], None]

log = logging.getLogger("demandops")


def without_secrets(text: str) -> str:
    """Return ``text`` without the user part of its URLs, which may hold a password."""
    return _USER.sub(r"\1", HAS_PASSWORD.sub(r"\1", text))


class RemoteRepository(StateRepository):
    """A bare clone of a remote; git runs with the user's configuration."""

    always_current = False
    main_reference = _REMOTE_MAIN

    def __init__(self, url: str, folder: Path, notify: Notify, allow_offline: bool) -> None:
        self.address = without_secrets(url)
        self._url = url
        self._folder = folder
        self._aborted = False
        self._process: subprocess.Popen[bytes] | None = None
        for lock in folder.rglob("*.lock"):  # of a killed process: no other uses the folder
            lock.unlink(missing_ok=True)
        if not self._is_usable():
            self._clone(notify)
        self._open()
        try:
            self.refresh()
        except RemoteAway as error:
            if not allow_offline:
                raise
            log.warning("%s; continuing with the commits of the last fetch", error)

    def _open(self) -> None:
        self._git, self.objects = git.Repo(self._folder), Repository(str(self._folder))
        self.new = NewObjects(self.objects)
        self.new.clean()

    def _is_usable(self) -> bool:
        try:
            repo = Repository(str(self._folder))
            commit = repo[repo.references[_REMOTE_MAIN].target]
            is_whole = isinstance(commit, pygit2.Commit) and bool(commit.tree.id)
            # git itself must find it: it reads more of the files than libgit2
            head = (self._folder / "HEAD").read_text()
            is_whole = is_whole and re.fullmatch(r"ref: refs/heads/\w+\n", head) is not None
            return is_whole and git.Repo(self._folder).remote("origin").url == self._url
        except Exception:  # whatever is wrong with it, a new one is not
            return False

    def renew_if_damaged(self) -> bool:
        """Make the clone anew if git finds it damaged."""
        try:
            with git.Repo(self._folder) as repo:
                self._run_git(repo, "fsck", "--no-dangling", "--no-progress")
            return False
        except RemoteAway:  # it was aborted
            return False
        except Exception as error:
            log.warning("the clone %s is damaged (%s); making it anew", self._folder, error)
        self._clone(log.info)
        self._open()
        return True

    def _clone(self, notify: Notify) -> None:
        notify(f"cloning {self.address}")
        self._folder.parent.mkdir(parents=True, exist_ok=True)
        partial = self._folder.with_name(self._folder.name + ".partial")
        shutil.rmtree(partial, ignore_errors=True)
        with git.Repo.init(partial, bare=True) as repo:
            with repo.config_writer() as config:
                config.set_value('remote "origin"', "url", self._url)
                config.set_value("gc", "auto", 0)
                # a fetch keeps its pack, which git syncs: libgit2 hangs on half a loose object
                config.set_value("fetch", "unpackLimit", 1)
            partial.joinpath("config").chmod(0o600)
            self._fetch(repo, timeout=_CLONE_TIMEOUT_S)
        if self._folder.exists():
            shutil.rmtree(self._folder)
        partial.rename(self._folder)

    def _fetch(
        self,
        repo: git.Repo,
        urgent: Callable[[], bool] = lambda: False,
        timeout: float = TIMEOUT_S,
    ) -> None:
        # given here, not configured, so that a push that outlives its generator moves no ref
        spec = f"+{MAIN}:{_REMOTE_MAIN}"
        self._read(repo, ("fetch", "--no-tags"), spec, urgent=urgent, timeout=timeout)

    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        """Fetch, but stop if something is urgent: a demand must not wait for a slow remote."""
        self._fetch(self._git, urgent)
        return self.tip()

    def publish(self, expected: Oid, commit: Oid) -> bool:
        """Push ``commit``; the remote accepts it only on top of its own tip."""
        try:  # the lease forces nothing: commit is on top
            with self.new.packed(commit):
                self.push(f"{commit}:{MAIN}", f"{MAIN}:{expected}")
        except git.GitCommandError as error:
            if _REMOTE_MOVED.search(str(error)):  # git compared first: nothing was sent
                return False
            tip = self.refresh()
            if tip == commit or self.objects.descendant_of(tip, commit):
                return True  # the push succeeded, but the answer was lost
            if tip != expected:
                return False
            raise self.push_error(error) from None
        try:
            self.objects.references.create(_REMOTE_MAIN, commit, force=True)
        except (pygit2.GitError, OSError) as error:  # the next fetch does it
            log.warning("%s was pushed, but not noted in %s: %s", commit, self._folder, error)
        return True

    def list_references(self, *patterns: str) -> dict[str, str]:
        """Return name → commit of the remote's references that match, or raise RemoteAway."""
        out = self._read(self._git, ("ls-remote",), *patterns)
        pairs = (line.split("\t", 1) for line in out.splitlines() if "\t" in line)
        return {name: commit for commit, name in pairs}

    def fetch_branches(self, prefix: str) -> None:
        """Fetch branches by prefix and drop those that were deleted, or raise RemoteAway."""
        spec = f"+refs/heads/{prefix}*:refs/remotes/origin/{prefix}*"
        self._read(self._git, ("fetch", "--no-tags", "--prune"), spec)

    def push(self, spec: str, lease: str, options: Sequence[str] = ()) -> str:
        """Push one reference and return git's output, or raise GitCommandError.

        Args:
            spec: ``<commit>:<reference>``, or ``:<reference>`` to delete it.
            lease: ``<reference>:<commit>``, which commit the remote must have; empty for none.
            options: options for the server (``git push --push-option``).
        """
        push_options = [f"--push-option={option}" for option in options]
        expects = f"--force-with-lease={lease}"
        out, err = self._run_git(
            self._git, "push", "--porcelain", *push_options, expects, "origin", spec
        )
        return f"{out}\n{err}"

    def push_error(self, error: git.GitCommandError) -> StateRepoError:
        """Return ``PushDenied`` if the remote rejected a push, else why it failed."""
        text = without_secrets(f"{error.stdout}\n{error.stderr}")
        if _NO_ROOM.search(text):
            return self._disk_full()
        rejected = _REMOTE_REJECTED.search(text)
        if rejected and not _TEMPORARY.search(rejected[1]):
            message = " ".join(line.strip(" '") for line in _REMOTE_MESSAGE.findall(text)).strip()
            reason = f"{rejected[1]}: {message}" if message else rejected[1]
            return PushDenied(f"{self.address} rejects the push: {reason}")
        if _NO_PERMISSION.search(text):
            return PushDenied(f"{self.address} rejects the push: {_last_line(text)}")
        reason = rejected[1] if rejected else _last_line(text)
        return RemoteAway(f"{self.address} cannot be pushed to: {reason}")

    def _read(
        self,
        repo: git.Repo,
        command: Sequence[str],
        *references: str,
        urgent: Callable[[], bool] = lambda: False,
        timeout: float = TIMEOUT_S,
    ) -> str:
        """Return the output of a git command that reads from the remote, or raise RemoteAway."""
        command = (*command, "--quiet", "origin", *references)
        try:
            return self._run_git(repo, *command, urgent=urgent, timeout=timeout)[0]
        except git.GitCommandError as error:
            text = without_secrets(str(error.stderr))
        if "couldn't find remote ref" in text:
            raise StateRepoError(
                f"{self.address} has no branch '{MAIN_BRANCH}'; push one made by "
                "`demandops init DIR`"
            )
        if _NO_ROOM.search(text):
            raise self._disk_full()
        failed = "read" if command[0] == "ls-remote" else "fetched"
        raise RemoteAway(f"{self.address} cannot be {failed}: {_last_line(text)}")

    def _disk_full(self) -> DiskFull:
        return DiskFull(
            f"{self.address} cannot be fetched or pushed: the disk of {self._folder} has no room; "
            "free some"
        )

    def _run_git(
        self,
        repo: git.Repo,
        *command: str,
        urgent: Callable[[], bool] = lambda: False,
        timeout: float = TIMEOUT_S,
    ) -> tuple[str, str]:
        if self._aborted:
            raise RemoteAway(f"{self.address}: the connection was aborted")
        with repo.git.custom_environment(**ENVIRONMENT):
            guard = repo.git.execute(  # keep a reference: it ends the process when it is collected
                [repo.git.GIT_PYTHON_GIT_EXECUTABLE, *command],
                as_process=True,
                start_new_session=True,
            )
        process = guard.proc
        assert process is not None  # noqa: S101 - it was started just now
        self._process = process
        if self._aborted:  # since the first check
            self.abort()
        try:
            out, err = _wait_for(process, urgent, timeout)
        finally:
            self._process = None
        if process.returncode:
            raise git.GitCommandError(list(command), process.returncode, err, out)
        return out.decode("utf-8", "replace"), err.decode("utf-8", "replace")

    def abort(self) -> None:
        """End the running git command and start no more."""
        self._aborted = True
        process = self._process
        if process is not None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)


def _wait_for(
    process: subprocess.Popen[bytes], urgent: Callable[[], bool], timeout: float
) -> tuple[bytes, bytes]:
    """Return git's output; end git if it takes too long or something is urgent."""
    end = REAL.monotonic() + timeout
    while True:
        try:
            return process.communicate(timeout=_POLL_S)
        except subprocess.TimeoutExpired:
            hurry = urgent()
            if not hurry and REAL.monotonic() < end:
                continue
            output = _terminate(process)
            if hurry:
                raise FetchInterrupted("the fetch was interrupted by a demand") from None
            return output


def _terminate(process: subprocess.Popen[bytes]) -> tuple[bytes, bytes]:
    """End git and its child processes; SIGTERM first, so that git removes its locks."""
    for number, patience in ((signal.SIGTERM, 1.0), (signal.SIGKILL, None)):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            return process.communicate(timeout=patience)
    raise AssertionError("a killed process has ended")  # pragma: no cover


def _last_line(text: str) -> str:
    text = text.replace("stderr: '", "")  # GitPython's prefix
    lines = [line.strip(" '\"") for line in text.splitlines() if line.strip(" '\"")]
    fatal = [line for line in lines if line.startswith(("fatal:", "error:", "remote:", "!"))]
    return (fatal or lines or ["git gave no reason"])[-1]
