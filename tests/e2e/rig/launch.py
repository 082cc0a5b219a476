"""A launcher of programs that die with the process that started them.

Run as `python -I -S launch.py PARENT_PID NICENESS PROGRAM ARGUMENT…`: it asks the kernel for a
SIGKILL on the parent's death and then becomes the program (same pid). Without it a test run ended
by `kill -9` would leave a cluster behind. It imports little, because each import delays every
start.

`subprocess`'s `preexec_fn` would do the same, but runs Python between fork and exec, which a
process with threads must not do.
"""

import ctypes
import os
import signal
import sys
from pathlib import Path

_PR_SET_PDEATHSIG = 1


def command(program: Path | str, *arguments: str, niceness: int = 0) -> list[str]:
    """Return the arguments that start `program` under this launcher in the calling process."""
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
