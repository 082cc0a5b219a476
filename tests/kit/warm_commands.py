"""Start commands fast: fork them from a process that has imported all modules.

The imports of a node take a second, and many tests start a node. Each command still has its own
process, threads, signals, log and exit code. Python must have only one thread when it forks. The
tests' own process has several, so another process forks. That process does not import ROS, because
the tracing of ROS starts threads, and a fork of a process with threads can crash. Each fork imports
ROS itself.
"""

from __future__ import annotations

import faulthandler
import gc
import importlib
import json
import os
import pkgutil
import random
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from select import select
from typing import IO, Any


class WarmCommand:
    """A forked command, with the members of `subprocess.Popen` that tests use."""

    def __init__(self, told: IO[str]) -> None:
        self._told = told
        self.pid = int(told.readline())
        self.returncode: int | None = None

    def poll(self) -> int | None:
        return self._ended(0)

    def wait(self, timeout: float | None = None) -> int:
        code = self._ended(timeout)
        if code is None:
            raise subprocess.TimeoutExpired("demandops", timeout or 0)
        return code

    def _ended(self, timeout: float | None) -> int | None:
        if self.returncode is None and select([self._told], [], [], timeout)[0]:
            self.returncode = int(self._told.readline())
            self._told.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class WarmCommands:
    def __init__(self, folder: Path) -> None:
        self._folder, self._started = folder, 0
        command = [sys.executable, "-m", "tests.kit.warm_commands"]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            text=True,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # else NumPy starts threads
        )

    def start(self, words: Sequence[str], environment: Mapping[str, str], log: Path) -> WarmCommand:
        pipe = self._folder / f"command-{self._started}"
        self._started += 1
        os.mkfifo(pipe)
        wanted = {"words": list(words), "environment": dict(environment), "log": str(log)}
        assert self._process.stdin is not None
        print(json.dumps(wanted | {"pipe": str(pipe)}), file=self._process.stdin, flush=True)
        return WarmCommand(pipe.open())

    def close(self) -> None:
        """End the process that forks; running commands go on."""
        self._process.communicate()


def import_all() -> None:
    import demandops

    for module in pkgutil.walk_packages(demandops.__path__, "demandops."):
        importlib.import_module(module.name)


def _watch(wanted: dict[str, Any]) -> int:
    """Return 0 in a new child; in the parent, report its id and exit code, and return its id."""
    with Path(wanted["pipe"]).open("w", buffering=1) as pipe:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        pid = os.fork()
        if pid:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            print(pid, file=pipe)
            _, status = os.waitpid(pid, 0)
            print(os.waitstatus_to_exitcode(status), file=pipe)
    return pid


def _become(wanted: dict[str, Any]) -> None:
    nothing = os.open(os.devnull, os.O_RDONLY)
    log = os.open(wanted["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for old, new in ((nothing, 0), (log, 1), (log, 2)):
        os.dup2(old, new)
    os.environ.clear()
    os.environ.update(wanted["environment"])
    random.seed()
    faulthandler.enable()
    from demandops.cli.main import main

    main(wanted["words"])


def _fork_for_each_line() -> None:
    import numpy  # noqa: F401 - ROS messages need it

    import_all()
    assert len(list(Path("/proc/self/task").iterdir())) == 1, "an import has started a thread"
    gc.collect()
    gc.freeze()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the parents of commands
    for line in sys.stdin:
        wanted = json.loads(line)
        if os.fork() == 0:
            if _watch(wanted):
                os._exit(0)
            _become(wanted)


if __name__ == "__main__":
    _fork_for_each_line()
