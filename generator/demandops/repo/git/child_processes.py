"""Runs git, and ends git, ssh and other programs if this process, which started them, is killed.

A killed process cannot end its children, and git may wait for a silent server for long. So a shell
waits beside this process, and ends all processes that inherited a mark in their environment: git,
and what git has started in turn. A mark needs no list of processes, which a kill could find
incomplete.
"""

from __future__ import annotations

import atexit
import os
import subprocess
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

from demandops.base.runtime import REAL

# The input ends without a line only if this process was killed. A process that is just being
# started has no mark yet, so the shell looks again for two seconds. grep has -z, because the
# kernel ends each variable in environ with a NUL byte.
_WATCH = r"""
read -r _ && exit
for round in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20; do
  for file in $(grep -Fsxlz -e "$1" /proc/[0-9]*/environ); do
    pid=${file#/proc/}
    kill -KILL "${pid%/environ}" 2>/dev/null
  done
  sleep 0.1
done
"""


def mark() -> dict[str, str]:
    """Return environment variables for programs that must end if this process is killed."""
    return _mark(os.getpid())


@cache  # by process: a fork is a process of its own, which may live longer
def _mark(pid: int) -> dict[str, str]:
    # with the number, because two forks of one process may make the same id
    name, value = "_DEMANDOPS_PROCESS", f"{pid} {REAL.fresh_id()}"
    watch = subprocess.Popen(
        ["sh", "-c", _WATCH, "demandops-watch", f"{name}={value}"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        bufsize=0,
        cwd="/",
        start_new_session=True,  # so that Ctrl-C does not end it
    )
    pipe = watch.stdin
    assert pipe is not None  # noqa: S101 - it was asked for

    def finish() -> None:
        with suppress(OSError, ValueError):  # after a fork, the pipe is the parent's
            pipe.write(b"\n")
            pipe.close()
            watch.wait()

    # the pipe must end with this process, also if a fork of it lives on
    os.register_at_fork(after_in_child=pipe.close)
    atexit.register(finish)
    return {name: value}


# ---- git, for what libgit2 cannot do ----

_ENVIRONMENT = {
    # git fails instead of asking for a password, because nobody may be there to answer
    "GIT_TERMINAL_PROMPT": "0",
    # git's errors are recognized by their English text
    "LC_ALL": "C",
    # git ends an HTTP transfer with less than 1 byte a second for 60 seconds
    "GIT_HTTP_LOW_SPEED_LIMIT": "1",
    "GIT_HTTP_LOW_SPEED_TIME": "60",
}


# Of a person's settings, those for access to the server count; those that start hooks, send more
# or colour what is parsed do not. The repository is named, as safe.bareRepository may hide it.
_SETTINGS = (
    f"core.hooksPath={os.devnull}", "push.pushOption=", "color.ui=false", "gc.auto=0",
    "maintenance.auto=false",
)  # fmt: skip


def git_environment() -> dict[str, str]:
    return _ENVIRONMENT | mark()


def git(folder: Path | str | None) -> list[str]:
    """Return how a command line begins that runs git, in the repository whose folder is given."""
    where = [f"--git-dir={folder}"] if folder else []
    return ["git", *where, *(word for each in _SETTINGS for word in ("-c", each))]


def run_git(
    folder: Path | str | None, *command: str, stdin: str = "", cwd: str | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*git(folder), *command],
        env=os.environ | git_environment(),
        input=stdin,
        cwd=cwd,
        capture_output=True,
        encoding="utf-8",
        errors="surrogateescape",
        check=False,
    )


# ---- who is told that git takes long with a remote ----

# A slow run of git calls each, each second, with a text about what git does, and with an empty text
# when git has ended.
listeners: list[Callable[[str], None]] = []
