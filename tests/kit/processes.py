"""Generators in processes of their own, which tests can kill."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.kit.goals import Goal
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import GIT_ENVIRONMENT

_CHECKOUT = Path(__file__).parents[2]
_SOURCES = (_CHECKOUT, _CHECKOUT / "generator", _CHECKOUT / "ros_bridge")


def demand(name: str, made: Goal, operation: str | None = None) -> dict[str, Any]:
    """Return a demand in the form that :meth:`Drivers.start` expects."""
    return {"name": name, "goal": made, "operation": operation or f"op-{name}"}


@dataclass
class Told:
    sent: list[str] = field(default_factory=list)
    answers: dict[str, dict[str, Any]] = field(default_factory=dict)
    withdrawn: list[str] = field(default_factory=list)
    finished: bool | None = None
    waits: dict[str, float] = field(default_factory=dict)
    """The seconds from each demand to its answer."""
    first: float = 0.0
    last: float = 0.0
    """When the first demand was sent, and the last event came."""


class Run:
    """A generator's process, and the events that it reports."""

    def __init__(self, pipe: Path) -> None:
        self._pipe = pipe
        self._told = Told()
        self._ended = False
        self.pid = 0

    def listen(self, on_ready: Callable[[], object] = lambda: None) -> Told:
        """Return all events at the end; ``on_ready`` is called when the process takes demands."""
        sent: dict[str, float] = {}
        with self._pipe.open() as lines:
            for line in lines:
                event = json.loads(line)
                self._told.last = time.monotonic()
                if "ready" in event:
                    self.pid = event["ready"]
                    on_ready()
                elif "sent" in event:
                    self._told.sent.append(event["sent"])
                    sent[event["sent"]] = self._told.last
                    self._told.first = self._told.first or self._told.last
                elif "answer" in event:
                    self._told.answers[event["answer"]] = event
                    self._told.waits[event["answer"]] = self._told.last - sent[event["answer"]]
                elif "withdrawn" in event:
                    self._told.withdrawn.append(event["withdrawn"])
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
            [sys.executable, "-m", "tests.kit.driver"],
            stdin=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, _SOURCES))},
        )

    def start(
        self,
        address: str | Path,
        lanes: list[list[dict[str, Any]]],
        *,
        opening: dict[str, Any] | None = None,
        die_at: str = "",
        cwd: Path | None = None,
    ) -> Run:
        pipe = self._folder / f"run-{len(list(self._folder.iterdir()))}"
        os.mkfifo(pipe)
        names = [*GIT_ENVIRONMENT, "DEMANDOPS_DATA_HOME"]
        plan = {
            "address": str(address),
            "lanes": lanes,
            "opening": opening,
            "die_at": die_at,
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
