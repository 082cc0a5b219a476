"""Generators in processes that tests can kill: the tests' end, and the program at the other end."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from demandops.serve import agenda
from demandops.serve.generator import Generator
from demandops.serve.journal import Journal, Receipt, Ticket

from tests.kit.goals import Goal
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import GIT_ENVIRONMENT, force_writes

_CHECKOUT = Path(__file__).parents[2]
_SOURCES = (_CHECKOUT, _CHECKOUT / "generator", _CHECKOUT / "ros_bridge")


def demand(name: str, made: Goal, operation: str | None = None) -> dict[str, Any]:
    """Return a demand in the form that :meth:`Drivers.start` expects."""
    return {"name": name, "goal": made, "operation": operation or f"op-{name}"}


@dataclass
class Told:
    sent: list[str] = field(default_factory=list)
    answers: dict[str, dict[str, Any]] = field(default_factory=dict)
    finished: bool | None = None


class Run:
    """A generator's process, and the events that it reports."""

    def __init__(self, pipe: Path) -> None:
        self._pipe = pipe
        self._told = Told()
        self._ended = False
        self.pid = 0

    def listen(self, on_ready: Callable[[], object] = lambda: None) -> Told:
        """Return all events at the end; ``on_ready`` is called when the process takes demands."""
        with self._pipe.open() as lines:
            for line in lines:
                event = json.loads(line)
                if "ready" in event:
                    self.pid = event["ready"]
                    on_ready()
                elif "sent" in event:
                    self._told.sent.append(event["sent"])
                elif "answer" in event:
                    self._told.answers[event["answer"]] = event
                elif "failed" in event:
                    raise AssertionError(f"the driver failed: {event['failed']}")
                else:
                    self._told.finished = event["finished"]
            self._ended = True
        return self._told

    def kill(self) -> None:
        if self.pid and not self._ended:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)


class Drivers:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._runs: list[Run] = []
        self.synced = False
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.kit.processes"],
            stdin=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, _SOURCES))},
        )

    def start(
        self,
        address: str | Path,
        lanes: list[list[dict[str, Any]]],
        *,
        dies: bool = False,
        cwd: Path | None = None,
    ) -> Run:
        """Start a generator; if it ``dies``, it does so once its first demands are journaled."""
        pipe = self._folder / f"run-{len(list(self._folder.iterdir()))}"
        os.mkfifo(pipe)
        names = [*GIT_ENVIRONMENT, "DEMANDOPS_DATA_HOME"]
        plan = {
            "address": str(address),
            "lanes": lanes,
            "dies": dies,
            "synced": self.synced,
            "cwd": str(cwd or Path.cwd()),
            "environment": {name: os.environ[name] for name in names},
            "to": str(pipe),
        }
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(plan) + "\n")
        self._process.stdin.flush()
        self._runs.append(Run(pipe))
        return self._runs[-1]

    def kill_runs(self) -> None:
        while self._runs:
            self._runs.pop().kill()

    def close(self) -> None:
        self.kill_runs()
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def listen_to_all(
    drivers: Drivers, runs: list[Run], on_ready: Callable[[], object] = lambda: None
) -> list[Told]:
    """Return the events of all runs at their end; ``on_ready`` is called when all have started."""
    waited_for = threading.Barrier(len(runs), on_ready)
    with ThreadPoolExecutor(len(runs)) as pool:
        try:
            return list(pool.map(lambda run: run.listen(lambda: waited_for.wait(PATIENCE_S)), runs))
        except BaseException:
            drivers.kill_runs()  # otherwise the pool would wait for the runs for ever
            raise


# ---- the program ----


def tell(**event: object) -> None:
    # a write of this size to a pipe is atomic, so lines of different threads do not mix
    os.write(1, (json.dumps(event)[:4000] + "\n").encode())


def die_once_journaled() -> None:
    """Let this process kill itself when its first demands are in the journal."""
    append = Journal.append

    def append_and_die(*args: Any) -> None:
        append(*args)
        os.kill(os.getpid(), signal.SIGKILL)

    Journal.append = append_and_die  # type: ignore[method-assign]


class Lanes:
    def __init__(self, generator: Generator, lanes: list[list[dict[str, Any]]]) -> None:
        self._generator = generator
        self._lanes = [lane for lane in lanes if lane]
        self._left = len(self._lanes)
        self._lock = threading.Lock()
        self.ended = threading.Event()
        if not self._left:
            self.ended.set()

    def start(self) -> None:
        """Send the first demand of each lane; return when all of these are in the journal."""
        wait([ticket.journaled for lane in self._lanes if (ticket := self._next(lane, 0))])

    def _next(self, lane: list[dict[str, Any]], index: int) -> Ticket | None:
        if index == len(lane):
            with self._lock:
                self._left -= 1
                if not self._left:
                    self.ended.set()
            return None
        tell(sent=lane[index]["name"])
        ticket = self._generator.submit(lane[index]["goal"], lane[index]["operation"])
        ticket.future.add_done_callback(lambda future: self._answered(lane, index, future))
        return ticket

    def _answered(self, lane: list[dict[str, Any]], index: int, future: Future[Receipt]) -> None:
        tell_answer(lane[index]["name"], future)
        self._next(lane, index + 1)


def tell_answer(name: str, future: Future[Receipt]) -> None:
    if error := future.exception():
        tell(answer=name, outcome=type(error).__name__, text=str(error), commit="")
    else:
        tell(answer=name, outcome=future.result().outcome, text="", commit=future.result().commit)


def run(plan: dict[str, Any]) -> None:
    force_writes(plan["synced"])
    agenda.LONGEST_EVALUATION_S = 60.0  # so that no slow machine publishes a batch in two parts
    if plan["dies"]:
        die_once_journaled()
    generator = Generator(plan["address"])
    tell(ready=os.getpid())
    lanes = Lanes(generator, plan["lanes"])
    lanes.start()
    lanes.ended.wait()
    tell(finished=generator.close(PATIENCE_S))


def main() -> None:
    """Import all modules once, and fork for every run; a run prints its events as lines of JSON.

    Each run comes from standard input, as one line of JSON. Its ``lanes`` are clients, each a list
    of demands. A client waits for an answer before it sends its next demand.
    """
    logging.basicConfig(level=logging.INFO, stream=sys.stderr)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for ended runs
    for line in sys.stdin:
        if os.fork():
            continue
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        plan = json.loads(line)
        os.environ.update(plan["environment"])
        os.chdir(plan["cwd"])
        os.dup2(os.open(plan["to"], os.O_WRONLY), 1)
        try:
            run(plan)
        except BaseException as error:
            logging.exception("the run ended early")
            tell(failed=repr(error))
        finally:
            os._exit(0)


if __name__ == "__main__":
    main()
