"""The state repo behind a URL: a bare clone, fetches, pushes, and what came of them.

What came of a command is known by what happened, not by words that others write: by git's exit
code, the porcelain line of a pushed reference, the answers over HTTP, and afterwards a look at the
remote. A push that fails has *moved* (another writer was first), is *refused* (the remote can be
read, and does not take it), or finds the remote *away*. Words only pick a remedy for a person.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import IO

import pygit2
from pygit2 import Oid, Repository

from demandops.base.addresses import holds_secret, without_secrets
from demandops.base.errors import StateRepoError
from demandops.base.quoting import one_line, quoted
from demandops.base.runtime import REAL, log
from demandops.base.settings import MAIN_BRANCH, data_home
from demandops.repo.git import child_processes
from demandops.repo.git import repository as repositories
from demandops.repo.git.objects import NewObjects
from demandops.repo.git.repository import MAIN, RemoteAway, StateRepository, Unavailable

# ---- one git command with a remote, and what came of it ----

# A server that asks for more patience than this is asked again all the same.
_LONGEST_RETRY_AFTER_S = 300.0
# A push that fails without a verdict after this time was not refused: its server is slow, or gone.
_LONGEST_REFUSAL_S = 30.0
# Lines of GIT_TRACE_CURL: a request, the status of an answer, and what a header says.
_HTTP = re.compile(
    r"=> Send header: ((?:GET|POST) )|<= Recv header: HTTP/\S+ ([2-5]\d\d)"
    r"|<= Recv header: (content-type|retry-after): *([^\r\n]*)",
    re.IGNORECASE,
)
# A line of ``git push --porcelain``: a reference, and what came of it.
_PORCELAIN = re.compile(r"^.\t[^\t\n]*:([^\t\n:]+)\t(\[.*?\])?(?: \((.*)\))?", re.MULTILINE)
# What git says after any failure; it hides what the server has said.
_SAYS_NOTHING = re.compile(
    r"fatal: Could not read from remote repository|fatal: the remote end hung up|"
    r"error: failed to push some refs|Please make sure you have the correct access|"
    r"and the repository exists|send-pack: unexpected disconnect|fatal: expected flush after|"
    r"fatal: unknown error occurred while reading the configuration files"
)
_PAGE = "a web page, such as a login, answers in place of a Git server; check the address"
_COLOURS = re.compile(r"\x1b\[[\d;]*[A-Za-z]")


@dataclass(frozen=True, slots=True)
class GitResult:
    code: int  # negative if git was ended by a signal
    out: str
    err: str
    http: str = ""  # the headers that git sent and received
    seconds: float = 0.0

    def line_of(self, reference: str) -> tuple[str, str]:
        """Return what git says of a pushed reference: ``[remote rejected]``, and the reason."""
        lines = (line[1:] for line in _PORCELAIN.findall(self.out) if line[0] == reference)
        return next(lines, ("", ""))

    def took(self, reference: str) -> bool:
        # not if the server did something else with the push, such as opening a merge request
        return not self.code and any(line[0] == reference for line in _PORCELAIN.findall(self.out))

    def is_verdict(self, reference: str) -> bool:
        """Whether the server has answered that it does not take the reference."""
        is_refused = 400 <= self._answer()[0] < 500 and not self.is_absence
        return self.line_of(reference)[0] == "[remote rejected]" or is_refused

    @property
    def is_page(self) -> bool:
        """Whether a login or a captive portal has answered, and not a Git server."""
        status, kind, _ = self._answer()
        return status == 200 and bool(kind) and not kind.startswith("application/x-git")

    @property
    def is_absence(self) -> bool:
        """Whether nobody has answered who could refuse something; a look at the remote may tell."""
        is_away = self._answer()[0] in (408, 425, 429, 503)
        return self.code < 0 or self.is_page or is_away

    @property
    def retry_after_s(self) -> float:
        text = self._answer()[2]
        with suppress(ValueError, TypeError):
            if not text.isdecimal():
                text = str((parsedate_to_datetime(text) - REAL.now()).total_seconds())
            return max(0.0, min(float(text), _LONGEST_RETRY_AFTER_S))
        return 0.0

    def _answer(self) -> tuple[int, str, str]:
        # the last answer: its status (0 if a request has none), Content-Type and Retry-After
        status, headers = 0, dict[str, str]()
        for sent, code, name, value in _HTTP.findall(self.http):
            if sent or code:
                status, headers = int(code or 0), {}
            else:
                headers[name.lower()] = value.strip()
        return status, headers.get("content-type", ""), headers.get("retry-after", "")

    @property
    def words(self) -> str:
        """What the server has said, in one line; else git's own words."""
        lines = [
            line.strip().removeprefix("remote:").strip()
            for line in re.split(r"[\r\n]", _COLOURS.sub("", without_secrets(self.err)))
            if not line.startswith("To ")
        ]
        lines = [line for line in lines if re.search(r"\w", line)]  # without frames
        telling = [line for line in lines if not _SAYS_NOTHING.search(line)] or lines
        return one_line(" ".join(dict.fromkeys(telling))) or "git gave no reason"


# Pairs: a pattern that matches a reason, in any case, and the remedy for a person.
_REMEDIES = (
    ("no space left on device", "free some room on the disk of the clone, or of the server"),
    (
        r"error: 40[13]|permission denied|access denied|authentication failed|"
        r"could not read (username|password)|host key verification failed",
        "git needs credentials for this address: a credential helper, ~/.netrc or an SSH key",
    ),
    (
        "not found|error: 404|does not appear to be a git",
        "check the path in the address, and whether you may read the repository",
    ),
    (
        "detected dubious ownership",
        "check the path in the address, and who owns the repository's files",
    ),
    (
        "not our ref 0{40}",
        "the server cannot read the branch: check the server's disk, and who may read the "
        "repository's files",
    ),
    (
        "resolve host|name or service not known|refused|timed out|unreachable|couldn't connect",
        "check the host and the port in the address, and the network",
    ),
    (r"\bconfig (value|variable|line)\b", "mend that line of your settings for git"),
)
# Git's error if it cannot read a file, here or on the server: credentials do not mend that.
_NO_FILE = re.compile(r"unable to access '[^':]*':.*")


# ---- the clone ----

_REMOTE_MAIN = f"refs/remotes/origin/{MAIN_BRANCH}"
_POLL_S = 0.02
_DOING = {"fetch": "fetching", "push": "pushing to", "fsck": "checking the clone of"}
_CLONE_TIMEOUT_S = 3600  # Git ends an idle HTTP transfer much earlier
# What git says if the remote also has a reference like ``refs/heads/refs/heads/main``.
_AMBIGUOUS = re.compile(r"^error: dst refspec \S+ matches more than one", re.MULTILINE)
# A person's settings for fetches and pushes of work trees do not count here. The remote is named by
# its URL, so no ``remote.origin.*`` counts either. Settings for access do: credentials, proxies,
# SSH, ``url.*.insteadOf``.
_FETCH = (
    "fetch", "--no-tags", "--no-recurse-submodules", "--no-auto-maintenance",
    "--no-write-fetch-head", "--no-write-commit-graph", "--quiet",
)  # fmt: skip
_PUSH = (
    "push", "--porcelain", "--no-verify", "--no-signed", "--no-follow-tags",
    "--no-force-if-includes", "--recurse-submodules=no",
)  # fmt: skip


class RemoteRepository(StateRepository):
    """A state repo behind a URL, in a bare clone."""

    always_current = on_this_disk = False
    main_reference = _REMOTE_MAIN

    def __init__(self, url: str, folder: Path, *, allow_offline: bool = False) -> None:
        self.address = without_secrets(url)
        self._url = url
        self._folder = folder
        self._aborted = False
        self._process: subprocess.Popen[bytes] | None = None
        # only this process uses the folder, so a killed process left these locks
        for lock in folder.rglob("*.lock"):
            lock.unlink(missing_ok=True)
        try:
            found = Repository(str(folder))
            commit = found[found.references[_REMOTE_MAIN].target]
            is_usable = isinstance(commit, pygit2.Commit) and bool(commit.tree.id)
            # git needs more of the files than libgit2, so check HEAD too
            head = (folder / "HEAD").read_text()
            is_usable = is_usable and re.fullmatch(r"ref: refs/heads/\w+\n", head) is not None
            is_usable = is_usable and found.config["remote.origin.url"] == url
        except Exception:  # whatever the damage, a new clone repairs it
            is_usable = False
        if not is_usable:
            self._clone()
        self._open()
        try:
            self.refresh()
        except RemoteAway as error:
            if not allow_offline:
                raise
            log.warning("%s; continuing with the commits of the last fetch", error)

    def _open(self) -> None:
        try:
            self.objects = Repository(str(self._folder))
        except pygit2.GitError:
            raise self._unreadable() from None
        self.new = NewObjects(self.objects)
        self.new.clean()

    def renew_if_damaged(self) -> bool:
        checked = self._run_git("fsck", "--no-dangling", "--no-progress")
        if not checked.code or self._aborted:
            return False
        text = "the clone %s does not pass git's check (%s); making it anew"
        log.warning(text, self._folder, checked.words)
        self._clone()
        self._open()
        return True

    def _clone(self) -> None:
        log.info("cloning %s", self.address)
        folder = self._folder
        folder.parent.mkdir(parents=True, exist_ok=True)
        # a killed process must not leave half a clone under the final name
        self._folder = folder.with_name(f"{folder.name}.partial")
        try:
            shutil.rmtree(self._folder, ignore_errors=True)
            # by libgit2, which copies no hooks and settings from a person's template
            made = pygit2.init_repository(str(self._folder), bare=True, initial_head=MAIN_BRANCH)
            made.config["remote.origin.url"] = self._url
            made.config["gc.auto"] = 0  # tidy joins the packs, not a fetch
            # Keep each fetched pack, because git syncs packs. Loose objects may be half-written
            # after a crash, and libgit2 hangs on them.
            made.config["fetch.unpackLimit"] = 1
            (self._folder / "config").chmod(0o600)
            self._fetch(timeout=_CLONE_TIMEOUT_S)
            if folder.exists():
                shutil.rmtree(folder)
            self._folder.rename(folder)
        finally:
            self._folder = folder

    def _fetch(
        self, urgent: Callable[[], bool] = lambda: False, timeout: float = repositories.TIMEOUT_S
    ) -> None:
        # The refspec is not in git's configuration. If it were, a push that outlives its generator
        # would move the reference.
        command = (*_FETCH, "--no-prune", self._url, f"+{MAIN}:{_REMOTE_MAIN}")
        fetched = self._run_git(*command, urgent=urgent, timeout=timeout)
        if not fetched.code:
            return
        if not fetched.is_absence:  # by its exit code, ls-remote tells that there is no such branch
            listing = ("ls-remote", "--quiet", "--exit-code", self._url, MAIN)
            listed = self._run_git(*listing, urgent=urgent)
            if listed.code == 2 and not listed.is_page:
                raise repositories.missing_main(self.address)
        raise self._read_error("fetched", fetched)

    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        self._fetch(urgent)
        return self.tip()

    def publish(self, expected: Oid, commit: Oid) -> bool:
        # --force-with-lease overwrites nothing, because ``commit`` follows ``expected``
        with repositories.using(f"the clone {self._folder}"), self.new.packed(commit):
            pushed = self.push(f"{commit}:{MAIN}", f"{MAIN}:{expected}")
        if not pushed.took(MAIN):
            if pushed.line_of(MAIN)[0] == "[rejected]":  # git sent nothing
                return False
            tip = self.refresh()
            if tip == commit or self.objects.descendant_of(tip, commit):
                return True  # the push succeeded, but the answer was lost
            if tip != expected:
                return False
            raise self.push_error(pushed, MAIN)
        try:
            self.objects.references.create(_REMOTE_MAIN, commit, force=True)
        except (pygit2.GitError, OSError) as error:  # the next fetch moves the reference
            text = "commit %s was pushed, but the clone %s cannot record this: %s"
            log.warning(text, commit, self._folder, error)
        return True

    def write_anew(self, since: str) -> None:
        pass  # the remote has synced what it confirms

    def list_references(self, *patterns: str) -> dict[str, str]:
        listed = self._run_git("ls-remote", "--quiet", self._url, *patterns)
        if listed.code or listed.is_page:
            raise self._read_error("read", listed)
        pairs = (line.split("\t", 1) for line in listed.out.splitlines() if "\t" in line)
        return {name: commit for commit, name in pairs}

    def fetch_branches(self, *prefixes: str) -> None:
        # what the remote has deleted, this clone deletes too
        specs = (f"+refs/heads/{each}*:refs/remotes/origin/{each}*" for each in prefixes)
        fetched = self._run_git(*_FETCH, "--prune", self._url, *specs)
        if fetched.code:
            raise self._read_error("fetched", fetched)

    def push(self, spec: str, lease: str, options: Sequence[str] = ()) -> GitResult:
        """Push one reference.

        ``spec`` is ``<commit>:<reference>``, or ``:<reference>`` to delete it. ``lease`` is
        ``<reference>:<commit>``: the commit that the remote's reference must have; if it is empty,
        the reference must not exist. ``options`` are those of ``git push --push-option``.
        """
        push_options = [f"--push-option={option}" for option in options]
        command = (*_PUSH, *push_options, f"--force-with-lease={lease}", self._url)
        pushed = self._run_git(*command, spec)
        commit, _, reference = spec.partition(":")
        if pushed.code and commit and _AMBIGUOUS.search(pushed.err):
            # Git finds a plain reference ambiguous if another one ends with it, but not the result
            # of a pattern. The source of a pattern must be a reference, so one is made.
            source = f"refs/pushed/{reference}"
            self.objects.references.create(source, Oid(hex=commit), force=True)
            try:
                pushed = self._run_git(*command, f"{source}*:{reference}*")
            finally:
                self.objects.references.delete(source)
        return pushed

    def push_error(self, pushed: GitResult, reference: str) -> StateRepoError:
        """Return PushDenied if the remote, which can be read, refused a push; else Unavailable."""
        is_verdict = pushed.is_verdict(reference)
        is_away = pushed.is_absence or pushed.seconds > _LONGEST_REFUSAL_S
        if not self._is_readable or (is_away and not is_verdict):
            return self._read_error("pushed to", pushed)
        reason = ": ".join(filter(None, (pushed.line_of(reference)[1], pushed.words)))
        if not pushed.code:
            reason = f"it takes the push, but leaves {reference} where it is"
        return repositories.PushDenied(
            f"{self.address} rejects the push: {reason}", is_verdict=is_verdict
        )

    def _read_error(self, doing: str, read: GitResult) -> Unavailable:
        if not self._is_readable:
            return self._unreadable()
        reason = _PAGE if read.is_page else read.words
        remediable = _NO_FILE.sub("", reason)
        remedies = (f"; {told}" for words, told in _REMEDIES if re.search(words, remediable, re.I))
        text = f"{self.address} cannot be {doing}: {reason}{next(remedies, '')}"
        return RemoteAway(text, read.retry_after_s)

    @property
    def _is_readable(self) -> bool:
        return (self._folder / "HEAD").is_file()

    def _unreadable(self) -> Unavailable:
        return Unavailable(
            f"{self.address} cannot be fetched or pushed: its clone {self._folder} cannot be read; "
            "check the clone's owner and disk, then start again, which replaces a damaged clone"
        )

    def _run_git(
        self,
        *command: str,
        urgent: Callable[[], bool] = lambda: False,
        timeout: float = repositories.TIMEOUT_S,
    ) -> GitResult:
        if self._aborted:
            raise RemoteAway(f"{self.address}: the connection was aborted")
        trace = self._folder.with_name("http.trace")  # git leaves credentials out of it
        trace.unlink(missing_ok=True)
        tracing = {"GIT_TRACE_CURL": str(trace), "GIT_TRACE_CURL_NO_DATA": "1"}
        process = subprocess.Popen(
            [*child_processes.git(self._folder), *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=self._folder.parent,
            env=os.environ | child_processes.git_environment() | tracing,
            start_new_session=True,
        )
        self._process = process
        if self._aborted:  # another thread has called abort since the first check
            self.abort()
        start, told = REAL.monotonic(), 0
        try:
            while True:
                with suppress(subprocess.TimeoutExpired):
                    out, err = process.communicate(timeout=_POLL_S)
                    break
                took = REAL.monotonic() - start
                if int(took) > told:
                    told, doing = int(took), _DOING.get(command[0], "asking")
                    for listener in child_processes.listeners:
                        listener(f"{doing} {self.address}, {told} s")
                self.while_waiting()
                if urgent():
                    raise repositories.FetchInterrupted("the fetch was interrupted by a demand")
                if took >= timeout:
                    out, err = _terminate(process)
                    break
        finally:
            if process.returncode is None:
                _terminate(process)
            self._process = None
            for listener in child_processes.listeners if told else ():
                listener("")
        texts = [text.decode("utf-8", "replace") for text in (out, err)]
        code, took = process.returncode, REAL.monotonic() - start
        if code < 0:
            ended = f"was ended by signal {-code}"
            ended = f"timed out after {timeout:g} s" if took >= timeout else ended
            texts[1] += f"\nfatal: git {ended}"
        http = trace.read_text(errors="replace") if trace.exists() else ""
        return GitResult(code, texts[0], texts[1], http, took)

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


# ---- a repository on this disk whose hooks and settings only `git push` obeys ----


class PushedRepository(RemoteRepository):
    on_this_disk = True

    def __init__(self, place: StateRepository, folder: Path) -> None:
        self._place = place
        super().__init__(str(Path(place.objects.path).resolve()), folder)

    def refresh(self, urgent: Callable[[], bool] = lambda: False) -> Oid:
        # to look is cheap, to fetch is not; git says why the repository cannot be read
        with suppress(pygit2.GitError, KeyError, OSError, StateRepoError):
            if self._place.tip() == self.tip():
                return self.tip()
        return super().refresh(urgent)

    def tidy(self) -> None:
        super().tidy()
        self._place.tidy()


# ---- folders on this machine: each holds the clone and the journal of one process at a time ----

_MAX_SLOTS = 256


class Slot:
    # Locked while its process lives. Several processes on one machine may serve one state repo;
    # each takes the first free slot.

    def __init__(self, root: Path) -> None:
        """Take a slot below ``root``; raise StateRepoError, or OSError about the slot's folder."""
        try:
            root.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise StateRepoError(
                f"the data folder {root} cannot be made: {error.strerror}; set DEMANDOPS_DATA_HOME "
                "to a writable folder"
            ) from None
        for number in range(_MAX_SLOTS):
            self.folder = root / f"slot-{number}"
            if (held := lock(self.folder)) is not None:
                self._lock = held
                return
        raise StateRepoError(f"{_MAX_SLOTS} processes already use {root}; stop some of them")

    def close(self) -> None:
        self._lock.close()


def lock(folder: Path) -> IO[str] | None:
    folder.mkdir(exist_ok=True, mode=0o700)
    handle = (folder / "lock").open("w")
    # the kernel releases this lock when the process dies in any way
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        handle.close()
        return None
    return handle


# ---- addresses: a folder, or a URL that Git can clone ----

_SCHEME = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]*)(://|::)")
_SCP = re.compile(r"^([^/\s:]+:(?!:)|[^/\s:]+@\[[^\]/]+\]:)")
_NO_HOST = re.compile(r"^(https?|ssh|git|git\+ssh)://([^/@]*@)?(:\d*)?(/|$)")
_ALLOWED = ("https", "http", "ssh", "git", "file", "git+ssh")


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


# What keeps a hint about a checkout from being given, and is told by what needs it
_UNREADABLE = (pygit2.GitError, OSError, KeyError, ValueError)


def commits_behind(checkout: Path) -> int:
    """Return how many commits of its origin's main a checkout of main lacks.

    Main is as a fetch of the checkout, or a command on this machine, has left it.
    """
    lacking = [0]
    with suppress(*_UNREADABLE):
        repo, origin = Repository(str(checkout)), origin_of(checkout) or ""
        home = data_home(origin)
        clones = [*home.glob("*/clone.git"), *home.glob("reader/*/clone.git")]
        places = [(origin, MAIN), *((place, _REMOTE_MAIN) for place in (checkout, *clones))]
        for place, reference in places if repo.head.shorthand == MAIN_BRANCH else ():
            with suppress(*_UNREADABLE):  # a URL; not yet fetched
                other = Repository(str(place))
                tip = other.references[reference].target
                lacking.append(other.ahead_behind(repo.head.target, tip)[1])
    return max(lacking)


def changed_in(checkout: Path) -> list[str]:
    """Return the files of a checkout that are not like this on its origin's main."""
    with suppress(*_UNREADABLE):
        repo = Repository(str(checkout))
        main = repo.branches[f"origin/{MAIN_BRANCH}"].target
        committed = repo.diff(repo.merge_base(repo.head.target, main) or main, repo.head.target)
        return sorted({*repo.status(), *(delta.new_file.path for delta in committed.deltas)})
    return []


def is_url(address: str) -> bool:
    exists = False
    with suppress(OSError):  # the address is too long, or in a folder that this user cannot read
        exists = Path(address).exists()
    # like git, which takes an existing folder ``a:b`` for a folder
    return not exists and bool(_SCHEME.match(address) or _SCP.match(address))


def connect(
    address: str, folder: Path, *, allow_offline: bool = False, only_read: bool = False
) -> StateRepository:
    """Return the state repo at an address: a URL, or the folder of a bare repository.

    The clone of what is pushed to is made in ``folder``; with ``allow_offline``, an existing one is
    used if its remote is away. With ``only_read``, the address may also be that of a checkout.
    """
    if is_url(address):
        scheme = _SCHEME.match(address)
        # git would start a program for other schemes: ``ext::COMMAND``, or git-remote-SCHEME
        if scheme and (scheme[2] == "::" or scheme[1] not in _ALLOWED):
            raise StateRepoError(
                f"a state repo's address cannot start with '{scheme[0]}'; use https, ssh, git or "
                "file"
            )
        if holds_secret(address):
            raise StateRepoError(
                "the state repo's address holds a password or token, which process lists would "
                "show; remove it and use a credential helper, ~/.netrc or an SSH key"
            )
        if no_host := _NO_HOST.match(address):
            raise StateRepoError(
                f"the state repo's address names no host after '{no_host[1]}://'; write "
                f"{no_host[1]}://HOST/PATH, or the folder of a bare repository"
            )
        return RemoteRepository(address, folder / "clone.git", allow_offline=allow_offline)
    try:
        path = Path(address).expanduser()
        is_folder, exists = path.is_dir(), path.exists()
        is_of_person = is_checkout(path)
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
    if is_of_person and not only_read:
        # a person may be editing the files, and would commit back what a demand has changed
        raise StateRepoError(
            f"{address} is a checkout, and DemandOps never writes to one; name its remote instead, "
            f"or use a bare clone: git clone --bare {path} {path}.git"
        )
    if is_of_person:
        return repositories.Checkout(path)
    repository = StateRepository(path)
    if only_read or not repositories.needs_push(address):
        return repository
    return PushedRepository(repository, folder / "clone.git")
