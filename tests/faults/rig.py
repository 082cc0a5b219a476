"""A state repo in a folder, and processes that book demands in it, with or without strace.

Each process is a fork of this one, which has imported all modules. This saves a second for each
process.
"""

from __future__ import annotations

import ctypes
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from functools import cache
from hashlib import sha256
from itertools import count
from pathlib import Path
from uuid import NAMESPACE_OID, uuid5

import yaml
from demandops.base.runtime import Runtime

from tests.faults.trace import Call, file_class, parse
from tests.kit.goals import numbered
from tests.kit.repo import NO_GIT_CONFIG, commits

LIMIT_S = 8.0
"""How many seconds a process that books a demand has until SIGTERM; it needs half a second."""
PATIENCE = 20
"""The limit on a busy machine, as a multiple of the time that a demand without a fault took."""
PLENTY_S = 300.0
"""How many seconds a command without a fault has; on a busy machine, one needed more than 60."""
END_S = 8.0
BEGIN = "/faults-begin"
_PRINTED = ("out", "err", "trace")
_FIRST_TIME = datetime(2026, 11, 1, tzinfo=timezone.utc)
"""The time of a rig's first process, of which each further one shows a minute more.

So each run makes the same commits and nearly the same calls, and a rig recognizes a disk
(:meth:`Rig.fingerprint`).
"""
_END_WITH_PARENT, _ADOPT_ORPHANS = 1, 36  # PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER
GIT = "git"
"""The value of ``Strace.at`` for all processes of git; each process gets a strace of its own."""


@dataclass(frozen=True)
class Strace:
    """The options of strace, and whom it traces: a thread, :data:`GIT`, or ``git push 1``."""

    options: Sequence[str]
    at: str = "MainThread"


@dataclass(frozen=True)
class Ran:
    """What a process did; ``lingers``: a child such as ``git push`` outlived it."""

    code: int
    out: str
    err: str
    calls: tuple[Call, ...] = ()
    """Those on the rig's files, of whom strace followed."""
    threads: frozenset[str] = frozenset()
    hangs: str = ""
    lingers: bool = False

    @property
    def commit(self) -> str:
        if self.code:
            return ""
        with suppress(ValueError, KeyError, IndexError):
            row = json.loads(self.out)[0]
            return row["commit"] if row["outcome"] in ("booked", "unchanged", "released") else ""
        return ""


class Rig:
    """A state repo, addressed by its URL if ``remote``, and processes that book demands in it."""

    def __init__(self, folder: Path, *, remote: bool) -> None:
        self.folder, self.remote = folder / "here", remote
        self.scratch, self._template = folder / "scratch", folder / "template"
        self.state, self.home = self.folder / "state.git", self.folder / "home"
        self.address = self.state.as_uri() if remote else str(self.state)
        self._runs = self._runs_of_template = 0
        self.proved: set[object] = set()
        """The states of the disk from which a restart was tried and found sound."""
        self.scratch.mkdir(parents=True)
        self._wrap_git()
        self.folder.mkdir()
        ctypes.CDLL(None).prctl(_ADOPT_ORPHANS, 1)  # so that :func:`_lingers` sees the orphans
        self.must(self.demandops("init", str(self.state), "--bare"))
        self.limit = 0.0
        self.is_slower(0)
        self.save()

    def _wrap_git(self) -> None:
        """Replace git's programs, even those that git starts, by a script that can trace them."""
        wrapper, self._git = self.scratch / "wrapper", self.scratch / "git-core"
        wrapper.write_bytes(Path(__file__).with_name("git.sh").read_bytes())
        wrapper.chmod(0o755)
        self._git.mkdir()
        for program in _git_core().glob("git*"):
            (self._git / program.name).symlink_to(wrapper)

    def is_slower(self, number: int) -> bool:
        """Book a demand without a fault; return whether the limit had to be raised."""
        began = time.monotonic()
        self.must(self.book(number, limit=PLENTY_S))
        before = self.limit
        self.limit = max(LIMIT_S, before, PATIENCE * (time.monotonic() - began))
        return self.limit > before

    def unlock_server(self) -> None:
        for lock in self.state.rglob("*.lock"):
            lock.unlink()

    def must(self, ran: Ran) -> Ran:
        assert ran.code == 0, f"{ran.code}: {ran.out}{ran.err}"
        return ran

    def save(self) -> None:
        """Copy all files, for :meth:`restore`, with times in the order of their names.

        Git opens the newest pack first, so packs of one age could be opened in any order.
        """
        shutil.rmtree(self._template, ignore_errors=True)
        shutil.copytree(self.folder, self._template, symlinks=True)
        files = sorted(path for path in self._template.rglob("*") if path.is_file())
        oldest = time.time() - len(files)
        for number, path in enumerate(files):
            os.utime(path, (oldest + number, oldest + number))
        self._runs_of_template = self._runs

    def restore(self) -> None:
        shutil.rmtree(self.folder)
        shutil.copytree(self._template, self.folder, symlinks=True)
        self._runs = self._runs_of_template

    def fingerprint(self) -> str:
        """Return a digest of what the next process will find: the files and the clock's time."""
        told = sha256(str(self._runs).encode())
        for path in sorted(self.folder.rglob("*")):
            name = file_class(str(path), self.folder)
            told.update(f"\0{name}\0{path.lstat().st_mode}\0".encode())
            if path.is_symlink():
                told.update(str(path.readlink()).encode())
            elif path.is_file():
                told.update(sha256(path.read_bytes()).digest())
        return told.hexdigest()

    def goal_file(self, number: int) -> Path:
        file = self.scratch / f"{number}.yaml"
        file.write_text(yaml.safe_dump(numbered(number)))
        return file

    def book(self, number: int, strace: Strace | None = None, limit: float = 0) -> Ran:
        file = str(self.goal_file(number))
        command = ("request", file, "--state-repo", self.address, "--output", "json")
        return self.demandops(*command, strace=strace, limit=limit or self.limit)

    def demandops(
        self, *command: str, strace: Strace | None = None, limit: float = PLENTY_S
    ) -> Ran:
        for name in _PRINTED:
            (self.scratch / name).unlink(missing_ok=True)
        traces = self.scratch / "traces"
        shutil.rmtree(traces, ignore_errors=True)
        traces.mkdir()
        environment = NO_GIT_CONFIG | {"DEMANDOPS_DATA_HOME": str(self.home)}
        if strace is not None and strace.at.split()[0] == GIT:
            environment |= {
                "PATH": f"{self._git}:{os.environ['PATH']}",
                "GIT_EXEC_PATH": str(self._git),
                "FAULTS_EXEC": str(_git_core()),
                "FAULTS_TRACES": str(traces),
                "FAULTS_AT": strace.at,
                "FAULTS_STRACE": " ".join(strace.options),
            }
        told, tell = os.pipe()
        waits, go = os.pipe()
        now = _FIRST_TIME + timedelta(minutes=self._runs)
        self._runs += 1
        process = os.fork()
        if process == 0:
            os.close(told)
            os.close(go)
            os.environ.update(environment)
            _make_repeatable(now)
            _become(command, self.scratch / "out", self.scratch / "err", tell, waits)
        os.close(tell)
        os.close(waits)
        return self._watch(process, told, go, strace, limit)

    def _watch(self, process: int, told: int, go: int, strace: Strace | None, limit: float) -> Ran:
        """Wait for the end of a process; trace the thread of ``strace`` from its start."""
        roles = {0: strace.at if strace else ""}
        tracer: subprocess.Popen[str] | None = None
        hangs, status = "", 0
        deadlines = [(limit, signal.SIGTERM), (limit + END_S, signal.SIGKILL)]
        began = time.monotonic()
        handle = os.pidfd_open(process)
        poll = select.poll()
        poll.register(told, select.POLLIN)
        poll.register(handle, select.POLLIN)
        while True:
            ready = dict(poll.poll(200))
            if told in ready:
                line = os.read(told, 1 << 12).decode()
                if not line:
                    poll.unregister(told)
                for each in line.splitlines():
                    name, number = each.rsplit(" ", 1)
                    roles[int(number)] = name
                    if strace is not None and name == strace.at:
                        tracer = _attach(strace, int(number), self.scratch / "trace")
                    with suppress(BrokenPipeError):  # the process ended as a thread began
                        os.write(go, b".")
            if handle in ready:
                status = os.waitpid(process, 0)[1]
                break
            if deadlines and time.monotonic() - began > deadlines[0][0]:
                number = deadlines.pop(0)[1]
                os.kill(process, number)
                hangs = "waits" if number == signal.SIGTERM else "does not end at SIGTERM"
        for end in (told, go, handle):
            os.close(end)
        if tracer is not None:
            tracer.communicate()
        out, err, trace = (_text(self.scratch / name) for name in _PRINTED)
        calls = (*parse(trace, roles, self.folder), *self._calls_of_git())
        code, threads = os.waitstatus_to_exitcode(status), frozenset(roles.values())
        return Ran(code, out, err, calls, threads, hangs, _lingers())

    def _calls_of_git(self) -> Iterator[Call]:
        for calls in sorted((self.scratch / "traces").glob("*.calls")):
            command, number = calls.stem.rsplit(" ", 1)
            folder = calls.with_suffix(".folder").read_text().strip()
            roles = {0: f"{GIT} {command}"}
            yield from parse(_text(calls), roles, self.folder, folder, int(number))


@cache
def _git_core() -> Path:
    return Path(subprocess.check_output(["git", "--exec-path"], text=True).strip())


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


def _lingers() -> bool:
    """Reap the orphans that have ended; return whether another one still runs."""
    while True:
        try:
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                return True
        except ChildProcessError:
            return False


def _attach(strace: Strace, thread: int, out: Path) -> subprocess.Popen[str]:
    command = ["strace", "-y", "-o", str(out), *strace.options, "-p", str(thread)]
    tracer = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert tracer.stderr is not None
    line = tracer.stderr.readline()
    assert "attached" in line, line
    return tracer


def _make_repeatable(now: datetime) -> None:
    """Stop the clock of this forked process at ``now``, and derive its fresh ids from ``now``."""
    numbers = count(1)

    def fresh_id(_: Runtime) -> str:
        return str(uuid5(NAMESPACE_OID, f"{now} {next(numbers)}"))

    Runtime.now = lambda _: now  # type: ignore[method-assign]
    Runtime.fresh_id = fresh_id  # type: ignore[method-assign]


def _become(command: Sequence[str], out: Path, err: Path, tell: int, waits: int) -> None:
    from demandops.cli import main

    code = 70
    try:
        ctypes.CDLL(None).prctl(_END_WITH_PARENT, signal.SIGKILL)  # also if the run is interrupted
        os.setsid()
        for path, number in ((out, 1), (err, 2)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115

        one_begins = threading.Lock()

        def begin(name: str) -> None:
            with one_begins:
                if select.select([waits], [], [], 0)[0]:
                    os.read(waits, 1)  # for the previous thread, whose own read strace would count
                os.write(tell, f"{name} {threading.get_native_id()}\n".encode())
                select.select([waits], [], [])
            with suppress(OSError):
                Path(BEGIN).stat()

        run: Callable[[threading.Thread], None] = threading.Thread.run

        def announced(thread: threading.Thread) -> None:
            begin(thread.name)
            run(thread)

        threading.Thread.run = announced  # type: ignore[method-assign]
        begin("MainThread")
        code = main.run(list(command))
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def commits_by_demand(rig: Rig) -> dict[int, list[str]]:
    found: dict[int, list[str]] = {}
    for commit in commits(rig.state):
        name = commit.one("Request-Id")
        if name.startswith("demand-"):
            found.setdefault(int(name.removeprefix("demand-")), []).append(commit.id)
    return found
