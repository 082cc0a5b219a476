"""The process in which templates, schemas and patterns of people are evaluated.

It reads pairs of lines, each JSON: the files that changed with the seconds that the evaluation may
take, then a task. It answers each pair with a line. The kernel ends it if it exceeds the seconds;
without its parent it ends itself.
"""

from __future__ import annotations

import json
import resource
import signal
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from demandops.base.errors import InvalidInput
from demandops.templating.values import SchemaTask, ValuesTask, evaluate


def serve(memory_mib: int) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + memory_mib * 1024 * 1024
    # if the machine lacks memory, the kernel ends this process rather than the generator
    Path("/proc/self/oom_score_adj").write_text("1000")
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    # it writes no file, and leaves no core file when the kernel ends it
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    files: dict[str, str] = {}
    while first := sys.stdin.buffer.readline():
        start, second = json.loads(first), sys.stdin.buffer.readline()
        for path, text in start["files"].items():
            if text is None:
                del files[path]
            else:
                files[path] = text
        began = _processor_time()
        # the kernel counts the time of all threads, also inside C and Rust, and then ends us
        signal.setitimer(signal.ITIMER_PROF, start["seconds"])
        answer = _answer(files, second)
        try:
            line = json.dumps(answer | {"seconds": _processor_time() - began})
        except (MemoryError, RecursionError):
            sys.exit(1)
        signal.setitimer(signal.ITIMER_PROF, 0)
        sys.stdout.buffer.write(line.encode("ascii") + b"\n")
        sys.stdout.buffer.flush()


def _answer(files: dict[str, str], question: bytes) -> dict[str, Any]:
    try:
        parts = json.loads(question)
        task = ValuesTask(**parts) if "context" in parts else SchemaTask(**parts)
        return {"values": evaluate(files, task)}
    except InvalidInput as error:
        return {"faults": [asdict(fault) for fault in error.faults]}
    except MemoryError:
        sys.exit(1)  # not enough may be left to go on
    except Exception as error:  # a bug of ours; the parent raises it
        return {"error": repr(error)}


def _processor_time() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
