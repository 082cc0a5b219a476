"""The rig's processes: start, watch, stop.

Each process leads its own process group, has a log file, and dies with this process. Because of the
group, Ctrl-C reaches only the tests, which then stop everything in order, and a stop also ends the
children of a process. A stop asks each process to end, and kills it after a deadline. Processes
stop in the reverse order of their start.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from . import ENDS_WITH_US, RigError
from .net import Probe

_POLL_SECONDS = 0.05
_TAIL_LINES = 30


@dataclass(frozen=True)
class Component:
    """A process to start: its command, a probe that says whether it is ready, and its URL."""

    name: str
    argv: tuple[str, ...]
    probe: Probe
    environment: Mapping[str, str] = field(default_factory=dict)
    ready_seconds: float = 240.0
    stop_seconds: float = 10.0
    url: str = ""


class Processes:
    def __init__(self, logs: Path, environment: Mapping[str, str]) -> None:
        self._logs, self._environment = logs, dict(environment)
        self._batches: list[list[str]] = []
        self._components: dict[str, Component] = {}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        logs.mkdir(parents=True, exist_ok=True)

    def start_together(self, components: Iterable[Component]) -> None:
        """Start components that do not need each other, then wait until all are ready."""
        batch = {component.name: component for component in components}
        self._batches.append([*batch])
        self._components |= batch
        for name in batch:
            self._launch(name)
        for name in batch:
            self._wait_ready(name)

    def start(self, name: str) -> None:
        """Start a component again, with the same arguments and ports; wait until it is ready."""
        if name in self._running:
            self.kill(name)
        self._launch(name)
        self._wait_ready(name)

    def check(self, *names: str) -> None:
        """Raise RigError if one of these components, or of all, has ended by itself."""
        for name in names or list(self._running):
            code = self._running[name].poll()
            if code is not None:
                raise RigError(self._with_log(name, f"ended with {code}"))

    def stop(self, *names: str) -> None:
        """Ask components to end, and kill those that do not."""
        going = {name: self._running.pop(name) for name in names if name in self._running}
        for process in going.values():
            # SIGCONT too, because a paused process would not handle the SIGTERM.
            _signal(process, signal.SIGTERM, signal.SIGCONT)
        for name, process in going.items():
            with suppress(subprocess.TimeoutExpired):
                process.wait(self._components[name].stop_seconds)
            _end(process)

    def kill(self, name: str) -> None:
        """Kill a component, as a crash would."""
        _end(self._running.pop(name))

    def pause(self, name: str) -> None:
        """Pause a component: it accepts connections and never answers."""
        _signal(self._running[name], signal.SIGSTOP)

    def resume(self, name: str) -> None:
        _signal(self._running[name], signal.SIGCONT)

    def stop_all(self) -> None:
        """Stop all components, the newest first; an interrupt meanwhile kills all that are left."""
        try:
            for batch in reversed(self._batches):
                self.stop(*batch)
        finally:
            for name in list(self._running):
                self.kill(name)

    def pids(self) -> dict[str, int]:
        return {name: process.pid for name, process in self._running.items()}

    def url(self, name: str) -> str:
        return self._components[name].url

    def log(self, name: str) -> Path:
        """Return the log file of a component; restarts append to it."""
        return self._logs / f"{name}.log"

    def _wait_ready(self, name: str) -> None:
        component = self._components[name]
        deadline = time.monotonic() + component.ready_seconds
        while (reason := component.probe()) is not None:
            self.check(name)
            if time.monotonic() > deadline:
                waited = f"not ready after {component.ready_seconds:.0f} s: {reason}"
                raise RigError(self._with_log(name, waited))
            time.sleep(_POLL_SECONDS)
        self.check(name)  # another server may have answered on the port

    def _launch(self, name: str) -> None:
        component = self._components[name]
        with self.log(name).open("ab") as log:
            log.write(f"--- {time.strftime('%H:%M:%S')} {' '.join(component.argv)}\n".encode())
            log.flush()
            # the kernel also kills the process when this thread ends: start no rig in another
            self._running[name] = subprocess.Popen(
                [*ENDS_WITH_US, *component.argv],
                env={**self._environment, **component.environment},
                cwd=self._logs,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def _with_log(self, name: str, what: str) -> str:
        path = self.log(name)
        with path.open(errors="replace") as log:
            tail = "".join(f"  {line}" for line in deque(log, maxlen=_TAIL_LINES))
        return f"{name}: {what}\n{path} ends with:\n{tail}"


def _signal(process: subprocess.Popen[bytes], *numbers: signal.Signals) -> None:
    for number in numbers:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)


def _end(process: subprocess.Popen[bytes]) -> None:
    _signal(process, signal.SIGKILL)
    process.wait()
