"""The rig's processes: start, watch, stop.

Each process leads its own process group, has a log file, and dies with this process. Because of the
group, Ctrl-C reaches only the tests, which then stop everything in order, and a stop also ends the
children of a process. A stop asks each process to end, and kills it after a deadline. Processes
stop in the reverse order of their start.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from . import launch
from .errors import RigError
from .net import Probe

_POLL_SECONDS = 0.05
_TAIL_LINES = 30
_GROUP_SECONDS = 3.0  # the longest wait for orphans, because some init processes never reap them


@dataclass(frozen=True)
class Component:
    """A process to start: its command, a probe that says whether it is ready, and its URL."""

    name: str
    argv: tuple[str, ...]
    probe: Probe
    environment: Mapping[str, str] = field(default_factory=dict)
    ready_seconds: float = 90.0
    stop_seconds: float = 10.0
    url: str = ""


class Processes:
    def __init__(self, logs: Path, environment: Mapping[str, str]) -> None:
        self._logs = logs
        self._environment = dict(environment)
        self._batches: list[list[str]] = []
        self._components: dict[str, Component] = {}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._started: dict[str, float] = {}
        logs.mkdir(parents=True, exist_ok=True)

    def start_together(self, components: Iterable[Component]) -> None:
        """Start components that do not need each other, then wait until all are ready."""
        batch = list(components)
        self._batches.append([component.name for component in batch])
        for component in batch:
            self._components[component.name] = component
            self._launch(component)
        for component in batch:
            self._wait_ready(component.name)

    def start(self, name: str) -> None:
        """Start a component again, with the same arguments and ports; wait until it is ready."""
        if name in self._running:
            self.kill(name)
        self._launch(self._components[name])
        self._wait_ready(name)

    def _wait_ready(self, name: str) -> None:
        """Wait until a component is ready; RigError has the reason and the end of the log."""
        component = self._components[name]
        deadline = time.monotonic() + component.ready_seconds
        while (reason := component.probe()) is not None:
            self.check(name)
            if time.monotonic() > deadline:
                waited = f"not ready after {component.ready_seconds:.0f} s: {reason}"
                raise RigError(self._with_log(name, waited))
            time.sleep(_POLL_SECONDS)
        self.check(name)  # another server may have answered on the port

    def check(self, *names: str) -> None:
        """Raise RigError if one of these components, or of all, has ended by itself."""
        for name in names or list(self._running):
            process = self._running.get(name)
            if process is not None and (code := _exit_code(process)) is not None:
                age = time.monotonic() - self._started[name]
                ended = f"ended with {code} after {age:.1f} s"
                raise RigError(self._with_log(name, ended))

    def stop(self, name: str) -> None:
        """Ask a component to end, and kill it if it does not."""
        self._stop_batch([name])

    def kill(self, name: str) -> None:
        """Kill a component, as a crash would."""
        _end(self._running.pop(name))

    def pause(self, name: str) -> None:
        """Pause a component: it accepts connections and never answers."""
        os.killpg(self._running[name].pid, signal.SIGSTOP)

    def resume(self, name: str) -> None:
        os.killpg(self._running[name].pid, signal.SIGCONT)

    def stop_all(self) -> None:
        """Stop all components, the newest first; an interrupt meanwhile kills all that are left."""
        try:
            for batch in reversed(self._batches):
                self._stop_batch(batch)
        finally:
            for process in list(self._running.values()):
                _end(process)
            self._running.clear()

    def pids(self) -> dict[str, int]:
        return {name: process.pid for name, process in self._running.items()}

    def url(self, name: str) -> str:
        return self._components[name].url

    def log(self, name: str) -> Path:
        """Return the log file of a component; restarts append to it."""
        return self._logs / f"{name}.log"

    def _launch(self, component: Component) -> None:
        argv = launch.command(component.argv[0], *component.argv[1:])
        environment = {**self._environment, **component.environment}
        with self.log(component.name).open("ab") as log:
            log.write(f"--- {time.strftime('%H:%M:%S')} {' '.join(component.argv)}\n".encode())
            log.flush()
            # the kernel also kills the process when this thread ends: start no rig in another
            process = subprocess.Popen(
                argv,
                env=environment,
                cwd=self._logs,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self._running[component.name] = process
        self._started[component.name] = time.monotonic()

    def _stop_batch(self, names: list[str]) -> None:
        going = {name: self._running[name] for name in names if name in self._running}
        for process in going.values():
            # SIGCONT too, because a paused process would not handle the SIGTERM.
            for number in (signal.SIGTERM, signal.SIGCONT):
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, number)
        start = time.monotonic()
        for name, process in going.items():
            deadline = start + self._components[name].stop_seconds
            while _exit_code(process) is None and time.monotonic() < deadline:
                time.sleep(_POLL_SECONDS)
            _end(process)
            del self._running[name]

    def _with_log(self, name: str, what: str) -> str:
        path = self.log(name)
        with path.open(errors="replace") as log:
            tail = "".join(f"  {line}" for line in deque(log, maxlen=_TAIL_LINES))
        return f"{name}: {what}\n{path} ends with:\n{tail}"


def _exit_code(process: subprocess.Popen[bytes]) -> int | None:
    """Return the exit code of a process without reaping it; None while it runs.

    After a reap, the kernel could give the pid to a new process, whose group `_end` would kill.
    """
    if process.returncode is not None:
        return process.returncode
    ended = os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    if ended is None:
        return None
    return ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and its group, reap it, and wait until the group is empty."""
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + _GROUP_SECONDS
    with contextlib.suppress(ProcessLookupError, PermissionError):
        while time.monotonic() < deadline:
            os.killpg(process.pid, 0)  # fails once the group is empty
            time.sleep(_POLL_SECONDS / 5)
