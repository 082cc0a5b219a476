"""A launcher of programs that die with the process that started them.

It runs as `python -I -S launch.py PARENT_PID NICENESS PROGRAM ARGUMENT…`. It asks the kernel for a
SIGKILL on the parent's death, and then becomes the program with the same pid. Without the launcher
a test run ended by `kill -9` would leave a cluster behind. The launcher imports little, because
each import delays every start.

The argument `preexec_fn` of `subprocess` would do the same, but it runs Python between fork and
exec, which is not safe in a process with threads.
"""

import ctypes
import os
import signal
import sys
from pathlib import Path

_PR_SET_PDEATHSIG = 1


def command(program: Path | str, *arguments: str, niceness: int = 0) -> list[str]:
    """Return the command line that starts `program` under this launcher."""
    interpreter = [sys.executable, "-I", "-S", str(Path(__file__).resolve())]
    return [*interpreter, str(os.getpid()), str(niceness), str(program), *arguments]


def _main() -> None:
    parent, niceness, program = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    if sys.platform == "linux":  # other systems have no such signal
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
    if os.getppid() != parent:
        raise SystemExit("the parent died before the kernel could watch it")
    if niceness:
        os.nice(niceness)
    os.execv(program, sys.argv[3:])  # noqa: S606 - no shell on purpose


if __name__ == "__main__":
    _main()
