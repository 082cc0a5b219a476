"""Start a program that dies with the process that asked for it.

Run as `python -I -S launch.py PARENT_PID NICENESS PROGRAM ARGUMENT…`: it asks the kernel for a
SIGKILL on the parent's death and then becomes the program (same pid). Without it a test run ended
by `kill -9` would leave a whole cluster behind. It knows nothing of the rig and imports only what
the interpreter holds anyway, for it stands before every start.

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
    """The argument list that starts `program` under this launcher, for the calling process."""
    interpreter = [sys.executable, "-I", "-S", str(Path(__file__).resolve())]
    return [*interpreter, str(os.getpid()), str(niceness), str(program), *arguments]


def _main() -> None:
    parent, niceness, program = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    if sys.platform == "linux":  # elsewhere an orderly stop is all there is
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
    if os.getppid() != parent:
        raise SystemExit("the parent died before its death could be watched")
    if niceness:
        os.nice(niceness)
    os.execv(program, sys.argv[3:])  # noqa: S606 - no shell is the point


if __name__ == "__main__":
    _main()
