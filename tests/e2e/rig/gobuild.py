"""Run the Go toolchain on one wrapper module.

A wrapper is a Go module under `tests/e2e/tools/` that pins the programs to build.

Only this module runs `go`, and only `tools` uses it. A build follows the committed `go.mod` and
`go.sum`, and ignores the caller's Go settings. It uses the installed Go and fetches no toolchain.
It runs at the lowest priority, because a build with an empty cache uses two cores for about twenty
minutes.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from . import launch
from .errors import RigError

JOBS_VARIABLE = "DEMANDOPS_E2E_BUILD_JOBS"
REMEDY = (
    "install Go {needed} or newer and put it on PATH (the distribution's package `golang`, or the "
    "archive that the Go project publishes)"
)
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
        asked = _run([program, "env", "GOVERSION", "GOOS", "GOARCH"], Path("/"), {})
        version, system, machine = asked.splitlines()
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
    def module(self) -> Path:
        """The folder with the copy of the wrapper; :meth:`vendor` adds the vendor folder to it."""
        return self.folder / "wrapper"

    def go(self, go: Go, *arguments: str) -> str:
        argv = launch.command(go.program, *arguments, niceness=19)
        own = {"GOMODCACHE": "modules", "GOCACHE": "compiled", "GOTMPDIR": ""}
        return _run(argv, self.module, {key: str(self.folder / own[key]) for key in own})

    def vendor(self, go: Go, wrapper: Path) -> None:
        """Copy the sources that the wrapper needs; Go compares them with `go.sum`."""
        pins = [folder / name for folder in (self.module, wrapper) for name in ("go.mod", "go.sum")]
        texts = [path.read_bytes() if path.exists() else b"" for path in pins]
        if (self.module / "vendor").is_dir() and texts[:2] == texts[2:]:
            return
        self.remove()  # a killed run may have left a folder with other versions
        shutil.copytree(wrapper, self.module)
        self.go(go, "mod", "vendor", "-o", "fetched")
        (self.module / "fetched").rename(self.module / "vendor")

    def drop_modules(self) -> None:
        shutil.rmtree(self.folder / "modules", ignore_errors=True)

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def build(
    go: Go, package: str, flags: list[str], target: Path, workspace: Workspace, report: Report
) -> None:
    flags = ["-mod=vendor", *flags]
    packages = workspace.go(go, "list", *flags, "-deps", package).split()
    # Go keeps a second copy of what a command compiles until the command ends. So each command
    # compiles only a part. Dependencies come before their users, so this costs no time.
    others = [each for each in packages if "." in each.partition("/")[0] and each != package]
    for start in range(0, len(others), _PACKAGES_AT_ONCE):
        report(f"compiling, {start} of {len(others)} packages done")
        workspace.go(go, "build", *flags, *others[start : start + _PACKAGES_AT_ONCE])
    workspace.go(go, "build", *flags, "-o", str(target), package)


def module_folder(go: Go, workspace: Workspace, module: str) -> str:
    """Return the folder of a module's unpacked sources, which exist until `drop_modules`."""
    # it fetches them again if an earlier build was interrupted after it had dropped them
    return str(json.loads(workspace.go(go, "mod", "download", "-json", module))["Dir"])


def _run(argv: list[str], folder: Path, own: dict[str, str]) -> str:
    jobs = os.environ.get(JOBS_VARIABLE, "")
    if jobs and not jobs.isdigit():
        raise RigError(f"{JOBS_VARIABLE}={jobs!r} is not a number; set how many jobs Go may run")
    # The linker strips debug information. Without it the compiler needs a third less disk space.
    flags = "-mod=readonly -modcacherw -gcflags=all=-dwarf=false" + (f" -p={jobs}" if jobs else "")
    settings = {"GOTOOLCHAIN": "local", "GOWORK": "off", "CGO_ENABLED": "0", "GOFLAGS": flags}
    # Settings for another system would give programs that do not run on this machine.
    dropped = {"GOOS", "GOARCH", "GOEXPERIMENT", "GO111MODULE"}
    kept = {key: value for key, value in os.environ.items() if key not in dropped}
    done = subprocess.run(
        argv,
        cwd=folder,
        env=kept | settings | own,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        lines = [
            line for line in done.stderr.splitlines() if not line.startswith("go: downloading")
        ]
        told = "\n".join(f"  {line}" for line in lines[-_SHOWN_LINES:])
        raise RigError(f"{folder}: `{' '.join(argv)}` failed with {done.returncode}:\n{told}")
    return done.stdout


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])
