"""Run the Go toolchain on one wrapper module, and report progress.

A wrapper is a Go module under `tests/e2e/tools/` that pins the programs to build.

Only this module runs `go`, and only `tools` uses it. A build follows the committed `go.mod` and
`go.sum`, and ignores the caller's Go settings. It uses the installed Go and fetches no toolchain.
It runs at the lowest priority, because a build with an empty cache uses two cores for about twenty
minutes.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import shutil
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from . import launch
from .errors import RigError

JOBS_VARIABLE = "DEMANDOPS_E2E_BUILD_JOBS"
REMEDY = (
    "install Go {needed} or newer and put it on PATH (the distribution's package `golang`, or the "
    "archive that the Go project publishes)"
)
_EVERY_SECONDS = 10.0
_SHOWN_LINES = 40
_PACKAGES_AT_ONCE = 400

Report = Callable[[str], None]


@dataclass(frozen=True)
class Go:
    program: str
    version: str  # like go1.26.8
    target: str  # like linux/amd64

    @staticmethod
    def find() -> Go:
        """Return the Go on PATH; raise RigError with the remedy if there is none."""
        program = shutil.which("go")
        if program is None:
            raise RigError("tests/e2e/tools: `go` is not on PATH: " + REMEDY.format(needed="1.26"))
        asked = ["GOVERSION", "GOOS", "GOARCH"]
        version, system, machine = _output([program, "env", *asked], Path("/")).splitlines()
        return Go(program, version, f"{system}/{machine}")

    def check(self, wrapper: Path) -> None:
        """Raise RigError if this Go is older than the wrapper's `go.mod` requires."""
        found = re.search(r"^go (\S+)$", (wrapper / "go.mod").read_text(), re.MULTILINE)
        needed = found.group(1) if found else "1.26"
        if _numbers(self.version) < _numbers(needed):
            have = f"{self.program} is {self.version}, too old for {wrapper / 'go.mod'}"
            raise RigError(f"{have}: {REMEDY.format(needed=needed)}")


@dataclass(frozen=True)
class Workspace:
    """A folder for one wrapper's builds, with its sources and compiled packages.

    The modules of all wrappers and their compiled packages would fill about 15 GB. So a workspace
    keeps only the sources that its wrapper builds, in a vendor folder, and is removed after the
    wrapper's last build.
    """

    folder: Path

    @property
    def environment(self) -> dict[str, str]:
        """The variables that make Go use this folder."""
        return {
            "GOMODCACHE": str(self.folder / "modules"),
            "GOCACHE": str(self.folder / "compiled"),
            "GOTMPDIR": str(self.folder),
        }

    @property
    def module(self) -> Path:
        """The folder with the copy of the wrapper; :meth:`vendor` adds the vendor folder to it."""
        return self.folder / "wrapper"

    def vendor(self, go: Go, wrapper: Path, report: Report) -> None:
        """Copy the sources of all packages that the wrapper needs into its vendor folder.

        Go compares the sources with `go.sum`.
        """
        pins = [
            (folder / name) for folder in (self.module, wrapper) for name in ("go.mod", "go.sum")
        ]
        texts = [path.read_bytes() if path.exists() else b"" for path in pins]
        if (self.module / "vendor").is_dir() and texts[:2] == texts[2:]:
            return
        self.remove()  # a killed run may have left a folder with other versions
        shutil.copytree(wrapper, self.module)
        fetched = _Counter(report, "fetched {count} modules")
        _watched([go.program, "mod", "vendor", "-o", "fetched"], self, fetched.line)
        (self.module / "fetched").rename(self.module / "vendor")

    def drop_modules(self) -> None:
        """Remove the downloaded modules; the vendor folder has what the build needs."""
        shutil.rmtree(self.folder / "modules", ignore_errors=True)

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def build(
    go: Go, package: str, flags: list[str], target: Path, workspace: Workspace, report: Report
) -> None:
    """Build `package` from the workspace's vendor folder into the file `target`."""
    flags = ["-mod=vendor", *flags]
    packages = _watched([go.program, "list", *flags, "-deps", package], workspace).split()
    text = f"compiled {{count}} of at most {len(packages)} packages"
    compiled = _Counter(report, text, set(packages))
    command = [go.program, "build", "-v", *flags]
    # Go keeps a second copy of what a command compiles until the command ends. So each command
    # compiles only a part. Dependencies come before their users, so this costs no time.
    others = [each for each in packages if "." in each.partition("/")[0] and each != package]
    for start in range(0, len(others), _PACKAGES_AT_ONCE):
        step = others[start : start + _PACKAGES_AT_ONCE]
        _watched([*command, *step], workspace, compiled.line, tick=compiled.tick)
    argv = [*command, "-o", str(target), package]
    _watched(argv, workspace, compiled.line, tick=compiled.tick)


def module_folder(go: Go, workspace: Workspace, module: str) -> str:
    """Return the folder of a module's unpacked sources, which exist until `drop_modules`."""
    argv = [go.program, "list", "-mod=mod", "-m", "-f", "{{.Dir}}", module]
    return _watched(argv, workspace).strip()


class _Counter:
    """Counts lines of progress and reports the count every few seconds."""

    def __init__(self, report: Report, text: str, expected: set[str] | None = None) -> None:
        self._report, self._text, self._expected = report, text, expected
        self._count, self._start = 0, time.monotonic()
        self._last = self._start

    def line(self, line: str) -> bool:
        """Count a line if it reports only progress; return whether it does."""
        progress = line.startswith("go: downloading")
        if self._expected is not None:
            progress = progress or line in self._expected
        self._count += progress
        self.tick()
        return progress

    def tick(self) -> None:
        now = time.monotonic()
        if now - self._last >= _EVERY_SECONDS:
            self._last = now
            text = self._text.format(count=self._count)
            self._report(f"{text}, {now - self._start:.0f} s")


def _watched(
    argv: list[str],
    workspace: Workspace,
    is_progress: Callable[[str], bool] = lambda line: False,
    tick: Callable[[], None] = lambda: None,
) -> str:
    """Run a command and return its standard output.

    The function `is_progress` is called with each line of the command's standard error, and says
    whether the line reports only progress. The function `tick` is called while no line comes.
    """
    folder = workspace.module
    process = subprocess.Popen(
        launch.command(argv[0], *argv[1:], niceness=19),
        cwd=folder,
        env=_environment() | workspace.environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    errors: queue.Queue[str | None] = queue.Queue()
    output: list[str] = []
    stdout = process.stdout
    threads = [
        threading.Thread(target=_pump, args=(process.stderr, errors), daemon=True),
        threading.Thread(target=lambda: output.append(stdout.read()), daemon=True),
    ]
    for thread in threads:
        thread.start()
    try:
        shown = _follow(errors, is_progress, tick)
        code = process.wait()
    except BaseException:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        raise
    finally:
        for thread in threads:
            thread.join(timeout=5)
        process.stdout.close()
        process.stderr.close()
    if code != 0:
        tail = "\n".join(f"  {text}" for text in shown)
        raise RigError(f"{folder}: `go {' '.join(argv[1:])}` failed with {code}:\n{tail}")
    return "".join(output)


def _pump(stream: IO[str], lines: queue.Queue[str | None]) -> None:
    for text in stream:
        lines.put(text.rstrip("\n"))
    lines.put(None)


def _follow(
    lines: queue.Queue[str | None], is_progress: Callable[[str], bool], tick: Callable[[], None]
) -> deque[str]:
    """Read lines until None comes; return the last lines that do not report progress.

    `is_progress` is called with each line. `tick` is called after each second without a line,
    because Go prints nothing while it links.
    """
    shown: deque[str] = deque(maxlen=_SHOWN_LINES)
    while True:
        try:
            text = lines.get(timeout=1)
        except queue.Empty:
            tick()
            continue
        if text is None:
            return shown
        if not is_progress(text):
            shown.append(text)


def _environment() -> dict[str, str]:
    jobs = os.environ.get(JOBS_VARIABLE, "")
    if jobs and not jobs.isdigit():
        raise RigError(f"{JOBS_VARIABLE}={jobs!r} is not a number; set how many jobs Go may run")
    # The linker strips debug information. Without it the compiler needs a third less disk space.
    flags = "-mod=readonly -modcacherw -gcflags=all=-dwarf=false" + (f" -p={jobs}" if jobs else "")
    settings = {"GOTOOLCHAIN": "local", "GOWORK": "off", "CGO_ENABLED": "0", "GOFLAGS": flags}
    # Settings for another system would give programs that do not run on this machine.
    dropped = {"GOOS", "GOARCH", "GOEXPERIMENT", "GO111MODULE"}
    return {k: v for k, v in os.environ.items() if k not in dropped} | settings


def _output(argv: list[str], folder: Path) -> str:
    done = subprocess.run(
        argv, cwd=folder, env=_environment(), capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise RigError(f"{folder}: `{' '.join(argv)}` failed: {done.stderr.strip()}")
    return done.stdout


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])
