"""One state repo at a fixed place, and processes that book demands in it, under strace or not.

A process is forked from this one, with all modules imported: that saves a second for each.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from tests.kit.goals import Goal, numbered
from tests.kit.repo import NO_GIT_CONFIG, commits, git

LIMIT_S = 8.0
"""A demand takes half a second. One that waits for its disk is asked to end after this time."""
PATIENCE = 20
"""On a busy machine a demand gets so many times what one took at first, if that is longer."""
PLENTY_S = 60.0
"""The limit where nothing goes wrong."""
END_S = 8.0
"""After SIGTERM, it must end within this time."""
BEGIN = "/faults-begin"

_GIT = """#!/bin/sh
# Has the first git command of the name that is asked for run under strace.
if [ "$1" = "$FAULTS_COMMAND" ] && mkdir "$FAULTS_ONCE" 2>/dev/null; then
  exec strace $FAULTS_STRACE "$FAULTS_GIT" "$@"
fi
exec "$FAULTS_GIT" "$@"
"""


@dataclass(frozen=True)
class Strace:
    """How to run strace, from when on: the start of a thread, or of a git command."""

    options: Sequence[str]
    at: str = "MainThread"


@dataclass(frozen=True)
class Ran:
    """What a process did."""

    code: int
    out: str
    err: str
    trace: str = ""
    roles: dict[int, str] = field(default_factory=dict)
    hangs: str = ""

    @property
    def commit(self) -> str:
        """The commit in which the demand is acknowledged, or empty."""
        if self.code:
            return ""
        with suppress(ValueError, KeyError, IndexError):
            row = json.loads(self.out)[0]
            return row["commit"] if row["outcome"] in ("booked", "unchanged", "released") else ""
        return ""


class Rig:
    """A state repo in which one demand is booked; ``remote``: reached by a URL."""

    def __init__(self, folder: Path, *, remote: bool) -> None:
        self.folder, self.remote = folder / "here", remote
        self.scratch, self._template = folder / "scratch", folder / "template"
        self.state, self.home = self.folder / "state.git", self.folder / "home"
        self.address = self.state.as_uri() if remote else str(self.state)
        self.scratch.mkdir(parents=True)
        wrapper = self.scratch / "git"
        wrapper.write_text(_GIT)
        wrapper.chmod(0o755)
        self.folder.mkdir()
        self.must(self.demandops("init", str(self.state), "--bare"))
        began = time.monotonic()
        self.limit = PLENTY_S
        self.must(self.book(0))
        self.limit = max(LIMIT_S, PATIENCE * (time.monotonic() - began))
        self.save()

    def must(self, ran: Ran) -> Ran:
        """Return the process' result; it must have done its work."""
        assert ran.code == 0, f"{ran.code}: {ran.out}{ran.err}"
        return ran

    def save(self) -> None:
        """Note the files as they are."""
        shutil.rmtree(self._template, ignore_errors=True)
        shutil.copytree(self.folder, self._template, symlinks=True)

    def restore(self) -> None:
        """Have the files as they were at :meth:`save`."""
        shutil.rmtree(self.folder)
        shutil.copytree(self._template, self.folder, symlinks=True)

    def book(self, number: int, strace: Strace | None = None, limit: float = 0) -> Ran:
        """Book a demand that is named by a number."""
        file = self.scratch / f"{number}.yaml"
        file.write_text(yaml.safe_dump(goal(number)))
        command = ("request", str(file), "--state-repo", self.address, "--output", "json")
        return self.demandops(*command, strace=strace, limit=limit or self.limit)

    def demandops(
        self, *command: str, strace: Strace | None = None, limit: float = PLENTY_S
    ) -> Ran:
        """Run a command in a process of its own."""
        paths = {name: self.scratch / name for name in ("out", "err", "trace", "once")}
        for path in paths.values():
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        environment = NO_GIT_CONFIG | {
            "DEMANDOPS_DATA_HOME": str(self.home),
            "PATH": f"{self.scratch}:{os.environ['PATH']}",
            "FAULTS_GIT": str(shutil.which("git")),
            "FAULTS_ONCE": str(paths["once"]),
        }
        if strace is not None:
            environment["FAULTS_COMMAND"] = strace.at
            environment["FAULTS_STRACE"] = " ".join(_strace(strace, paths["trace"])[1:])
        told, tell = os.pipe()
        waits, go = os.pipe()
        process = os.fork()
        if process == 0:
            os.close(told)
            os.close(go)
            os.environ.update(environment)
            _become(command, paths["out"], paths["err"], tell, waits)
        os.close(tell)
        os.close(waits)
        return self._watch(process, told, go, strace, paths, limit)

    def _watch(
        self,
        process: int,
        told: int,
        go: int,
        strace: Strace | None,
        paths: dict[str, Path],
        limit: float,
    ) -> Ran:
        """Attach strace when the thread starts that it is for, and wait for the process' end."""
        roles: dict[int, str] = {}
        alone = 0  # the thread that is traced; strace writes no numbers then
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
                        tracer = _attach(strace, int(number), paths["trace"])
                        alone = 0 if "-f" in strace.options else int(number)
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
        del paths["once"]
        texts = {
            name: path.read_text(errors="replace") if path.exists() else ""
            for name, path in paths.items()
        }
        if alone:
            texts["trace"] = "".join(f"{alone} {line}\n" for line in texts["trace"].splitlines())
        return Ran(os.waitstatus_to_exitcode(status), roles=roles, hangs=hangs, **texts)


def goal(number: int) -> Goal:
    """Return the demand of a number; each has its own requester."""
    return numbered(number)


def _strace(strace: Strace, out: Path) -> list[str]:
    return ["strace", "-y", "-o", str(out), *strace.options]


def _attach(strace: Strace, thread: int, out: Path) -> subprocess.Popen[str]:
    tracer = subprocess.Popen(
        [*_strace(strace, out), "-p", str(thread)], stderr=subprocess.PIPE, text=True
    )
    assert tracer.stderr is not None
    line = tracer.stderr.readline()
    assert "attached" in line, line
    return tracer


def _become(command: Sequence[str], out: Path, err: Path, tell: int, waits: int) -> None:
    """Run the command line in this forked process, and end."""
    from demandops.cli import main

    code = 70
    try:
        os.setsid()
        for path, number in ((out, 1), (err, 2)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115

        one_begins = threading.Lock()

        def begin(name: str) -> None:
            with one_begins:
                if select.select([waits], [], [], 0)[0]:
                    os.read(waits, 1)  # of the thread before: strace must count no read of this one
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


def demands(rig: Rig) -> dict[int, list[str]]:
    """Return the commits of each demand that is booked, by its number."""
    found: dict[int, list[str]] = {}
    for commit in commits(rig.state):
        name = commit.one("Request-Id")
        if name.startswith("demand-"):
            found.setdefault(int(name.removeprefix("demand-")), []).append(commit.id)
    return found


def includes(rig: Rig, commit: str) -> bool:
    """Return whether main has a commit."""
    return commit in git(rig.state, "rev-list", "main").split()
