"""Computes the values of services in a child process, which can be killed.

Templates, schemas and patterns that people merge may never end, or take all memory. So each is
evaluated by a child with limits (:mod:`.child`) that knows neither the
environment nor the open files of this process. The kernel ends a child that exceeds its limits;
the demand is refused, and the next evaluation starts another child.

A child serves one evaluation at a time. It keeps the files that it was sent, so that a demand sends
only what changed since.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, fields
from math import inf
from pathlib import Path
from types import MappingProxyType
from typing import Any

from demandops.base import errors
from demandops.base.errors import Fault, InvalidInput, OverLimit
from demandops.base.runtime import log
from demandops.templating.values import SchemaTask, ValuesTask

# How many seconds of processor time the evaluations of one demand may take together. The values of
# a service with 8,000 topics take half of it.
DEMAND_S = 0.5
MEMORY_MIB = 512
_MOST_IDLE = 2  # the worker's and the page's
_LONGEST_ANSWER = 64_000_000
# Waiting for an answer is bounded too, in case the child is stopped. A busy machine runs it slowly.
_LONGEST_WAIT_S = 60
_START = (
    "import sys, json; sys.path[:] = json.loads(sys.argv[1]); "
    f"from demandops.templating import child; child.serve({MEMORY_MIB})"
)


@dataclass(slots=True)
class _Limits:
    """Seconds of processor time: for each evaluation, and left for all of them together."""

    each: float
    left: float
    meanwhile: Callable[[], object] = lambda: None
    # A file that took too long for one release is not tried for others, as long as no file changes
    files: Mapping[str, str] = field(default_factory=dict)
    late: dict[str, OverLimit] = field(default_factory=dict)


_limits: ContextVar[_Limits] = ContextVar("limits")


@contextmanager
def processor_time(
    each: float, together: float = inf, meanwhile: Callable[[], object] = lambda: None
) -> Iterator[None]:
    """Limit the processor time of the evaluations in the block, in seconds.

    ``meanwhile`` is called before each of them. Without a block, an evaluation may take 2 seconds.
    """
    token = _limits.set(_Limits(each, together, meanwhile))
    try:
        yield
    finally:
        _limits.reset(token)


class Evaluator:
    """Evaluates in child processes; threads may call it at the same time."""

    def __init__(self) -> None:
        self._idle: list[_Child] = []

    def __call__(self, files: Mapping[str, str], task: ValuesTask | SchemaTask) -> dict[str, Any]:
        limits = _limits.get(None) or _Limits(2, inf)
        limits.meanwhile()
        if files is not limits.files:
            limits.files, limits.late = files, {}
        if task.file in limits.late:
            raise limits.late[task.file]
        seconds = min(limits.each, limits.left)
        if seconds <= 0:
            raise _over(task, "the evaluations before it took all the time of this demand")
        while True:
            try:
                child, is_fresh = self._idle.pop(), False  # threads may share a list in CPython
            except IndexError:
                child, is_fresh = _Child(), True
            try:
                answer = child.answer(files, task, seconds)
                break
            except _Died as death:
                # somebody may have ended an idle child, or it kept much of earlier evaluations
                if is_fresh or death.is_late:
                    limits.left -= seconds if death.is_late else 0
                    limits.late[task.file] = _over(task, str(death))
                    raise limits.late[task.file] from None
            except BaseException:
                child.kill()  # its answer was not read, so the next one would be taken for it
                raise
        if len(self._idle) < _MOST_IDLE:
            self._idle.append(child)
        else:
            child.kill()
        limits.left -= answer["seconds"]
        if "faults" in answer:
            raise InvalidInput(Fault(**fault) for fault in answer["faults"])
        if "error" in answer:
            raise RuntimeError(f"evaluation of {task.file} failed: {answer['error']}")
        values: dict[str, Any] = answer["values"]
        return values

    def forget(self) -> None:
        # without ending them, because a forked process has its parent's children here
        self._idle = []


def _over(task: ValuesTask | SchemaTask, reason: str) -> OverLimit:
    message = f"{reason}; make it simpler, or its chart's values.schema.json"
    error = OverLimit([errors.fault("", message, code="over-limit").within(task.file)])
    log.warning("%s", error)
    return error


class _Died(Exception):
    """Raised if a child ended, or was ended, before it answered, maybe for lack of time."""

    def __init__(self, reason: str, *, is_late: bool = False) -> None:
        super().__init__(reason)
        self.is_late = is_late


class _Child:
    def __init__(self) -> None:
        package = str(Path(__file__).parents[2])
        self._socket, theirs = socket.socketpair()
        with theirs:
            # -S leaves out what packages run at each start; the path has all that it would add
            self._process = subprocess.Popen(
                [sys.executable, "-s", "-S", "-c", _START, json.dumps([package, *sys.path])],
                stdin=theirs.fileno(),
                stdout=theirs.fileno(),
                stderr=subprocess.DEVNULL,
                cwd="/",
                env={"LC_ALL": "C.UTF-8", "PYTHONHASHSEED": "0"},
                start_new_session=True,  # ctrl-c ends this process, which then ends the child
            )
        self._files: Mapping[str, str] = MappingProxyType({})

    def answer(
        self, files: Mapping[str, str], task: ValuesTask | SchemaTask, seconds: float
    ) -> dict[str, Any]:
        """Return the child's answer; raise _Died if it ends or takes more than ``seconds``."""
        changed: dict[str, str | None] = {}
        if files is not self._files:
            sent, self._files = self._files, files
            changed = {path: text for path, text in files.items() if sent.get(path) != text}
            changed |= dict.fromkeys(sent.keys() - files.keys())
        parts = {field.name: getattr(task, field.name) for field in fields(task)}
        # Two lines: there are no line breaks within JSON. ASCII has an escape for what UTF-8 cannot
        # encode.
        head = {"files": changed, "seconds": seconds}
        lines = (json.dumps(line, default=dict) + "\n" for line in (head, parts))
        answer = bytearray()
        self._socket.settimeout(_LONGEST_WAIT_S + 20 * seconds)
        try:
            self._socket.sendall("".join(lines).encode("ascii"))
            while not answer.endswith(b"\n") and (piece := self._socket.recv(1_000_000)):
                answer += piece
                if len(answer) > _LONGEST_ANSWER:
                    self.kill()
                    raise _Died(f"gives more than {_LONGEST_ANSWER} characters")
        except TimeoutError:
            self.kill()
            raise _Died("gave no answer for a long time", is_late=True) from None
        except ConnectionError:  # the child ended
            answer.clear()
        if not answer.endswith(b"\n"):
            self._socket.close()
            if self._process.wait() == -signal.SIGPROF:  # the timer that the child sets
                reason = f"takes more than {seconds:.3g} s of processor time"
                raise _Died(reason, is_late=True)
            raise _Died(f"takes more than {MEMORY_MIB} MiB of memory, or is nested too deeply")
        read: dict[str, Any] = json.loads(answer)
        return read

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self._socket.close()


EVALUATE = Evaluator()
os.register_at_fork(after_in_child=EVALUATE.forget)
