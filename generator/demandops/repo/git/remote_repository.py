"""The state repo behind a URL: a bare clone, fetches, pushes, and the errors of git."""

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

from demandops.base.addresses import without_secrets
from demandops.base.errors import StateRepoError
from demandops.base.runtime import REAL
from demandops.base.settings import MAIN_BRANCH
from demandops.repo.git import repository as repositories
from demandops.repo.git.objects import NewObjects
from demandops.repo.git.repository import MAIN, DiskFull, FetchInterrupted, RemoteAway, Unavailable
from demandops.repo.git.slow_git import SlowGit

_REMOTE_MAIN = f"refs/remotes/origin/{MAIN_BRANCH}"
_REMOTE_MOVED = re.compile(r"\[rejected\]")
_REMOTE_MESSAGE = re.compile(r"remote: ?(.*)")
_REMOTE_REJECTED = re.compile(r"\[remote rejected\] \((.*)\)")
# A temporary rejection: the cause is the server or another writer, not a rule.
_TEMPORARY = re.compile(
    r"lock|failed to update ref|incorrect old value|unpack|bad pack|"
    r"unable to (create|migrate|write)"
)
# The reason of a permanent rejection: the server will never accept the push.
_RULE = re.compile(r"fsck|exceeds maximum|[Ii]nsufficient permission")
# Lines at the end of git's output that do not give the reason of a failure.
_WITHOUT_REASON = re.compile(
    r"fatal: Could not read from remote repository|fatal: the remote end hung up|"
    r"error: failed to push some refs|Please make sure you have the correct access|"
    r"and the repository exists|send-pack: unexpected disconnect|fatal: expected flush after|"
    r"fatal: unknown error occurred while reading the configuration files"
)
# Pairs: a pattern that matches git's reason, and the remedy for a person.
_REMEDIES = (
    (
        re.compile(r"resolve host|Name or service not known", re.IGNORECASE),
        "check the host in the address, and the network",
    ),
    (
        re.compile(
            r"returned error: 40[13]|permission denied|access denied|authentication failed|"
            r"could not read (username|password)|host key verification failed",
            re.IGNORECASE,
        ),
        "git needs credentials for this address: a credential helper, ~/.netrc or an SSH key",
    ),
    (
        re.compile(r"not found|returned error: 404|does not appear to be a git", re.IGNORECASE),
        "check the path in the address, and whether you may read the repository",
    ),
    (
        re.compile(r"detected dubious ownership"),
        "check the path in the address, and who owns the repository's files",
    ),
    (
        re.compile(r"not our ref 0{40}"),
        "the server cannot read the branch: check the server's disk, and who may read the "
        "repository's files",
    ),
    (
        re.compile(r"refused|timed out|unreachable|couldn't connect", re.IGNORECASE),
        "check the host and the port in the address, and the network",
    ),
)
# Git's error if the remote also has a reference like ``refs/heads/refs/heads/main``.
_AMBIGUOUS = re.compile(r"dst refspec \S+ matches more than one")
_POLL_S = 0.02
_DOING = {"fetch": "fetching", "push": "pushing to", "fsck": "checking the clone of"}
_CLONE_TIMEOUT_S = 3600  # Git ends an idle HTTP transfer much earlier
# This machine's disk, not the server's, whose errors begin with ``remote:``.
_NO_ROOM = re.compile(r"^(?!remote:).*No space left on device", re.MULTILINE)
# Git's errors about its own clone: unreadable, or without the remote ``origin``.
_NO_CLONE = re.compile(
    r"^(?!remote:).*fatal: (not a git repository|'origin' does not appear to be a git|"
    r"detected dubious ownership in repository at '.*/clone\.git')",
    re.MULTILINE,
)
# Git's error if it cannot read a file, here or on the server. Its error about a URL that it cannot
# reach does not match, because a URL has a colon.
_NO_FILE = re.compile(r".*unable to access '[^':]*':.*")
_NO_PERMISSION = re.compile(
    r"returned error: 40[13]|Permission denied|access denied", re.IGNORECASE
)

Notify = Callable[[str], None]

log = logging.getLogger("demandops")


class RemoteRepository(repositories.StateRepository):
    """A state repo behind a URL, in a bare clone. Git runs with the user's configuration."""

    always_current = False
    main_reference = _REMOTE_MAIN
    branches = "refs/remotes/origin/"

    def __init__(self, url: str, folder: Path, notify: Notify, allow_offline: bool) -> None:
        self.address = without_secrets(url)
        self._url = url
        self._folder = folder
        self._aborted = False
        self._process: subprocess.Popen[bytes] | None = None
        # only this process uses the folder, so a killed process left these locks
        for lock in folder.rglob("*.lock"):
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
        try:
            self._git = git.Repo(self._folder)
        except (git.InvalidGitRepositoryError, git.NoSuchPathError):
            raise self._unreadable() from None
        self.objects = Repository(str(self._folder))
        self.new = NewObjects(self.objects)
        self.new.clean()

    def _is_usable(self) -> bool:
        try:
            repo = Repository(str(self._folder))
            commit = repo[repo.references[_REMOTE_MAIN].target]
            is_whole = isinstance(commit, pygit2.Commit) and bool(commit.tree.id)
            # git needs more of the files than libgit2, so check HEAD too
            head = (self._folder / "HEAD").read_text()
            is_whole = is_whole and re.fullmatch(r"ref: refs/heads/\w+\n", head) is not None
            return is_whole and git.Repo(self._folder).remote("origin").url == self._url
        except Exception:  # whatever the damage, a new clone repairs it
            return False

    def renew_if_damaged(self) -> bool:
        try:
            with git.Repo(self._folder) as repo:
                self._run_git(repo, "fsck", "--no-dangling", "--no-progress")
            return False
        except RemoteAway:  # the check was aborted
            return False
        except Exception as error:
            log.warning(
                "the clone %s does not pass git's check (%s); making it anew", self._folder, error
            )
        self._clone(log.info)
        self._open()
        return True

    def _clone(self, notify: Notify) -> None:
        notify(f"cloning {self.address}")
        self._folder.parent.mkdir(parents=True, exist_ok=True)
        # a killed process must not leave half a clone under the final name
        partial = self._folder.with_name(self._folder.name + ".partial")
        shutil.rmtree(partial, ignore_errors=True)
        with git.Repo.init(partial, bare=True, object_format="sha1") as repo:
            with repo.config_writer() as config:
                config.set_value('remote "origin"', "url", self._url)
                config.set_value("gc", "auto", 0)  # tidy joins the packs, not a fetch
                # Keep each fetched pack, because git syncs packs. Loose objects may be half-written
                # after a crash, and libgit2 hangs on them.
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
        timeout: float = repositories.TIMEOUT_S,
    ) -> None:
        # The refspec is not in git's configuration. If it were, a push that outlives its generator
        # would move the reference.
        spec = f"+{MAIN}:{_REMOTE_MAIN}"
        self._read_remote(repo, ("fetch", "--no-tags"), spec, urgent=urgent, timeout=timeout)

    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        self._fetch(self._git, urgent)
        return self.tip()

    def publish(self, expected: Oid, commit: Oid) -> bool:
        # --force-with-lease overwrites nothing, because ``commit`` follows ``expected``
        try:
            with self.new.packed(commit):
                self.push(f"{commit}:{MAIN}", f"{MAIN}:{expected}")
        except (pygit2.GitError, OSError) as error:
            raise repositories.access_error(error, f"the clone {self._folder}") from None
        except git.GitCommandError as error:
            if _REMOTE_MOVED.search(str(error)):  # git sent nothing
                return False
            tip = self.refresh()
            if tip == commit or self.objects.descendant_of(tip, commit):
                return True  # the push succeeded, but the answer was lost
            if tip != expected:
                return False
            raise self.push_error(error) from None
        try:
            self.objects.references.create(_REMOTE_MAIN, commit, force=True)
        except (pygit2.GitError, OSError) as error:  # the next fetch moves the reference
            text = "commit %s was pushed, but the clone %s cannot record this: %s"
            log.warning(text, commit, self._folder, error)
        return True

    def list_references(self, *patterns: str) -> dict[str, str]:
        # name → commit; the patterns are those of ``git ls-remote``
        out = self._read_remote(self._git, ("ls-remote",), *patterns)
        pairs = (line.split("\t", 1) for line in out.splitlines() if "\t" in line)
        return {name: commit for commit, name in pairs}

    def fetch_branches(self, prefix: str) -> None:
        # what the remote has deleted, this clone deletes too
        spec = f"+refs/heads/{prefix}*:refs/remotes/origin/{prefix}*"
        self._read_remote(self._git, ("fetch", "--no-tags", "--prune"), spec)

    def push(self, spec: str, lease: str, options: Sequence[str] = ()) -> str:
        """Push one reference and return git's output, or raise GitCommandError.

        ``spec`` is ``<commit>:<reference>``, or ``:<reference>`` to delete it. ``lease`` is
        ``<reference>:<commit>``: the commit that the remote's reference must have; if it is empty,
        the reference must not exist. ``options`` are those of ``git push --push-option``.
        """
        push_options = [f"--push-option={option}" for option in options]
        command = ("push", "--porcelain", *push_options, f"--force-with-lease={lease}", "origin")
        try:
            out, err = self._run_git(self._git, *command, spec)
        except git.GitCommandError as error:
            commit, _, reference = spec.partition(":")
            if not commit or not _AMBIGUOUS.search(str(error.stderr)):
                raise
            # Git finds a plain reference ambiguous if another one ends with it, but not the result
            # of a pattern. The source of a pattern must be a reference, so one is made.
            pushed = f"refs/pushed/{reference}"
            self.objects.references.create(pushed, Oid(hex=commit), force=True)
            try:
                out, err = self._run_git(self._git, *command, f"{pushed}*:{reference}*")
            finally:
                self.objects.references.delete(pushed)
        return f"{out}\n{err}"

    def push_error(self, error: git.GitCommandError) -> StateRepoError:
        """Return PushDenied if another attempt at a push would fail too, else Unavailable."""
        text = without_secrets(f"{error.stdout}\n{error.stderr}")
        if error_here := self._error_of_clone(text):
            return error_here
        rejected, reason = _REMOTE_REJECTED.search(text), _reason(text)
        if rejected:
            message = " ".join(line.strip(" '") for line in _REMOTE_MESSAGE.findall(text)).strip()
            reason = f"{rejected[1]}: {message}" if message else rejected[1]
            is_final = bool(_RULE.search(text)) or not _TEMPORARY.search(rejected[1])
        else:
            is_final = bool(_NO_PERMISSION.search(_NO_FILE.sub("", text)))
        if is_final:
            return repositories.PushDenied(f"{self.address} rejects the push: {reason}")
        return RemoteAway(f"{self.address} cannot be pushed to: {reason}")

    def _read_remote(
        self,
        repo: git.Repo,
        command: Sequence[str],
        *references: str,
        urgent: Callable[[], bool] = lambda: False,
        timeout: float = repositories.TIMEOUT_S,
    ) -> str:
        command = (*command, "--quiet", "origin", *references)
        try:
            return self._run_git(repo, *command, urgent=urgent, timeout=timeout)[0]
        except git.GitCommandError as error:
            text = without_secrets(str(error.stderr))
        if "couldn't find remote ref" in text:
            raise repositories.missing_main(self.address)
        if error_here := self._error_of_clone(text):
            raise error_here
        failed = "read" if command[0] == "ls-remote" else "fetched"
        reason = _reason(text)
        remediable = _NO_FILE.sub("", reason)  # credentials do not make a file readable
        remedy = next((f"; {told}" for words, told in _REMEDIES if words.search(remediable)), "")
        raise RemoteAway(f"{self.address} cannot be {failed}: {reason}{remedy}")

    def _unreadable(self) -> Unavailable:
        return Unavailable(
            f"{self.address} cannot be fetched or pushed: its clone {self._folder} cannot be read; "
            "check the clone's owner and disk, then start again, which replaces a damaged clone"
        )

    def _error_of_clone(self, text: str) -> Unavailable | None:
        if _NO_ROOM.search(text):
            return DiskFull(
                f"{self.address} cannot be fetched or pushed: the disk of {self._folder} has no "
                "room; free some"
            )
        return self._unreadable() if _NO_CLONE.search(text) else None

    def _run_git(
        self,
        repo: git.Repo,
        *command: str,
        urgent: Callable[[], bool] = lambda: False,
        timeout: float = repositories.TIMEOUT_S,
    ) -> tuple[str, str]:
        if self._aborted:
            raise RemoteAway(f"{self.address}: the connection was aborted")
        with repo.git.custom_environment(**repositories.git_environment()):
            guard = repo.git.execute(  # keep the guard: its garbage collection ends the process
                [repo.git.GIT_PYTHON_GIT_EXECUTABLE, *command],
                as_process=True,
                start_new_session=True,
            )
        process = guard.proc
        assert process is not None  # noqa: S101 - it was started just now
        self._process = process
        if self._aborted:  # another thread has called abort since the first check
            self.abort()
        slow = SlowGit(f"{_DOING.get(command[0], 'asking')} {self.address}")
        start = REAL.monotonic()
        try:
            while True:
                with suppress(subprocess.TimeoutExpired):
                    out, err = process.communicate(timeout=_POLL_S)
                    break
                slow.lasts(REAL.monotonic() - start)
                self.while_waiting()
                if urgent():
                    _terminate(process)
                    raise FetchInterrupted("the fetch was interrupted by a demand")
                if REAL.monotonic() - start >= timeout:
                    out, err = _terminate(process)
                    break
        finally:
            self._process = None
            slow.ends()
        if process.returncode < 0:
            err += f"\nfatal: git was ended by signal {-process.returncode}".encode()
        if process.returncode and REAL.monotonic() - start >= timeout:
            err += f"\nfatal: git timed out after {timeout:g} s".encode()
        if process.returncode:
            raise git.GitCommandError(list(command), process.returncode, err, out)
        return out.decode("utf-8", "replace"), err.decode("utf-8", "replace")

    def abort(self) -> None:
        self._aborted = True
        process = self._process
        if process is not None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)


def _terminate(process: subprocess.Popen[bytes]) -> tuple[bytes, bytes]:
    # first by SIGTERM, so that git can remove its locks
    for number, patience in ((signal.SIGTERM, 1.0), (signal.SIGKILL, None)):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            return process.communicate(timeout=patience)
    raise AssertionError("a killed process has ended")  # pragma: no cover


def _reason(text: str) -> str:
    # GitPython puts git's output into quotation marks
    text = text.replace("stderr: '", "")
    stripped = [line.strip(' "') for line in text.splitlines() if line.strip(" '\"")]
    lines = [line.removesuffix("'") if line.count("'") % 2 else line for line in stripped]
    telling = [line for line in lines if not _WITHOUT_REASON.search(line)] or lines
    fatal = [line for line in telling if line.startswith(("fatal:", "error:", "remote:", "!"))]
    return (fatal or telling or ["git gave no reason"])[-1].rstrip(".")
