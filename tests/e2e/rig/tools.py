"""Build the rig's programs from pinned Go modules, once, into a cache outside the checkout.

The other modules of the rig take the paths that `ensure` returns. Each program is pinned by a Go
module of its own under `tests/e2e/tools/`, its wrapper, whose `go.sum` covers all dependencies.

The name of a cache entry is a digest of everything that decides the program's bytes. A finished
entry is renamed into the cache, so each existing entry is complete.

A build follows the committed `go.mod` and `go.sum`, and ignores the caller's Go settings. It uses
the installed Go and fetches no toolchain. It runs at the lowest priority, because a build with an
empty cache uses two cores for about twenty minutes.

`python -m tests.e2e.rig.tools` builds all programs. With `--for flux` it builds the programs of a
rig with Flux.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

from . import ENDS_WITH_US, RigError

WRAPPERS = Path(__file__).resolve().parent.parent / "tools"
CACHE_VARIABLE = "DEMANDOPS_E2E_CACHE"
_BUILDING = ".building-"

Report = Callable[[str], None]

_ARGOCD = "github.com/argoproj/argo-cd/v3"
_CRD_FOLDERS = ("config/crd/bases", "manifests/crds")  # Flux's, Argo CD's
_SHOWN_LINES = 40
_PACKAGES_AT_ONCE = 400


@dataclass(frozen=True)
class Tool:
    """A program to build: its name, the wrapper module that pins it, and its main package."""

    name: str
    wrapper: str
    package: str
    crds_of: str = ""  # the Go module whose CRDs are copied next to the program
    gitops: str = ""  # the only GitOps controller that needs it; empty if all do


def _flux(name: str) -> Tool:
    module = f"github.com/fluxcd/{name}"
    return Tool(name, name, module, crds_of=module, gitops="flux")


def _kubernetes(name: str) -> Tool:
    return Tool(name, "kubernetes", f"k8s.io/kubernetes/cmd/{name}")


# The cheapest builds come first, so that a wrong set-up fails within a minute.
TOOLS = {
    tool.name: tool
    for tool in (
        Tool("etcd", "etcd", "go.etcd.io/etcd/server/v3"),
        _kubernetes("kube-apiserver"),
        _kubernetes("kube-controller-manager"),
        _kubernetes("kube-scheduler"),
        Tool("kwok", "kwok", "sigs.k8s.io/kwok/cmd/kwok"),
        _flux("source-controller"),
        _flux("kustomize-controller"),
        _flux("helm-controller"),
        Tool("helm", "helm", "helm.sh/helm/v4/cmd/helm"),
        Tool("argocd", "argocd", f"{_ARGOCD}/cmd", crds_of=_ARGOCD, gitops="argocd"),
    )
}


def ensure(names: Iterable[str], report: Report | None = None) -> dict[str, Path]:
    """Return the paths of these programs, after building what the cache lacks; raise RigError."""
    wanted, say = [TOOLS[name] for name in names], report or _to_stderr
    if shutil.which("go") is None:
        raise RigError("tests/e2e/tools: `go` is not on PATH: `make go` installs it into build/")
    version, *target = _go(Path("/"), {}, "env", "GOVERSION", "GOOS", "GOARCH").splitlines()
    entries = {
        tool: cache_root() / f"{tool.name}-{_digest(tool, version, target)}" for tool in wanted
    }
    if not all(entry.is_dir() for entry in entries.values()):
        with _turn(cache_root(), say):
            # another run may have built some while we waited
            missing = [tool for tool in wanted if not entries[tool].is_dir()]
            for wrapper, tools in groupby(missing, lambda tool: tool.wrapper):
                with TemporaryDirectory(prefix=_BUILDING, dir=cache_root()) as workspace:
                    _build(Path(workspace), WRAPPERS / wrapper, {t: entries[t] for t in tools}, say)
    return {tool.name: entry / tool.name for tool, entry in entries.items()}


def needed_with(*gitops: str) -> list[str]:
    return [tool.name for tool in TOOLS.values() if tool.gitops in ("", *gitops)]


def crd_files(binaries: dict[str, Path]) -> list[Path]:
    return sorted(
        path for binary in binaries.values() for path in binary.parent.glob("crds/*.yaml")
    )


def cache_root() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    named = os.environ.get(CACHE_VARIABLE) or f"{base}/demandops/e2e"
    return Path(named).expanduser().resolve()


def _digest(tool: Tool, version: str, target: list[str]) -> str:
    """Return a digest of what decides a program's bytes: pins, flags, toolchain and target."""
    folder, built = WRAPPERS / tool.wrapper, [version, "/".join(target)]
    parts = [
        (folder / "go.mod").read_bytes(),
        (folder / "go.sum").read_bytes(),
        json.dumps([tool.package, tool.crds_of, _flags(tool), *built]).encode(),
    ]
    joined = b"\0".join(hashlib.sha256(part).digest() for part in parts)
    return hashlib.sha256(joined).hexdigest()[:16]


def _flags(tool: Tool) -> list[str]:
    """Return build flags for small binaries; the bytes must not depend on the checkout's path."""
    linker = ["-s", "-w"]
    if tool.wrapper == "kubernetes":
        # Without a version stamp the server reports v0.0.0-master, which clients refuse.
        pins = (WRAPPERS / tool.wrapper / "go.mod").read_text()
        (version,) = re.findall(r"^\s*(?:require )?k8s\.io/kubernetes (v\S+)", pins, re.MULTILINE)
        major, minor = version.removeprefix("v").split(".")[:2]
        stamps = {"gitVersion": version, "gitMajor": major, "gitMinor": minor}
        linker += [
            f"-X k8s.io/component-base/version.{key}={value}" for key, value in stamps.items()
        ]
    return ["-trimpath", "-buildvcs=false", f"-ldflags={' '.join(linker)}"]


@contextlib.contextmanager
def _turn(root: Path, say: Report) -> Iterator[None]:
    """Hold the build lock, because two builds of Kubernetes at once do not fit into memory."""
    root.mkdir(parents=True, exist_ok=True)
    with (root / "build.lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # freed by the kernel on death
        except BlockingIOError:
            say(f"another run is building into {root}, waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        for leftover in root.glob(f"{_BUILDING}*"):  # only of killed builds, as we hold the lock
            shutil.rmtree(leftover, ignore_errors=True)
        yield


def _build(workspace: Path, wrapper: Path, entries: dict[Tool, Path], say: Report) -> None:
    """Build programs of one wrapper in a folder that goes afterwards.

    The modules of all wrappers and their compiled packages would fill about 15 GB. So a workspace
    has only the sources that its wrapper builds, in a vendor folder.
    """
    module, own = workspace / "wrapper", {"GOCACHE": "compiled", "GOMODCACHE": "modules"}
    own = {name: str(workspace / folder) for name, folder in own.items()}

    def go(*arguments: str) -> str:
        return _go(module, own | {"GOTMPDIR": str(workspace)}, *arguments)

    say(f"fetching modules for {', '.join(tool.name for tool in entries)}")
    shutil.copytree(wrapper, module)
    go("mod", "vendor", "-o", "fetched")  # this compares the sources with `go.sum`
    (module / "fetched").rename(module / "vendor")
    for tool in entries:
        (workspace / tool.name).mkdir()
        if tool.crds_of:
            unpacked = json.loads(go("mod", "download", "-json", tool.crds_of))
            _copy_crds(Path(unpacked["Dir"]), workspace / tool.name / "crds")
    shutil.rmtree(workspace / "modules", ignore_errors=True)
    for tool, entry in entries.items():
        start, flags = time.monotonic(), ["-mod=vendor", *_flags(tool)]
        packages = go("list", *flags, "-deps", tool.package).split()
        # Go keeps a second copy of what a command compiles until the command ends. So each command
        # compiles only a part. Dependencies come before their users, so this costs no time.
        others = [one for one in packages if "." in one.partition("/")[0] and one != tool.package]
        for first in range(0, len(others), _PACKAGES_AT_ONCE):
            say(f"compiling {tool.name}, {first} of {len(others)} packages done")
            go("build", *flags, *others[first : first + _PACKAGES_AT_ONCE])
        binary = workspace / tool.name / tool.name
        go("build", *flags, "-o", str(binary), tool.package)
        with binary.open("rb") as written:
            os.fsync(written.fileno())  # otherwise a power cut could leave an empty file
        binary.parent.rename(entry)
        say(f"built in {time.monotonic() - start:.0f} s")


def _copy_crds(module: Path, target: Path) -> None:
    target.mkdir()
    found = (path for folder in _CRD_FOLDERS for path in (module / folder).glob("*.yaml"))
    sources = sorted(path for path in found if path.name != "kustomization.yaml")
    if not sources:
        raise RigError(f"{module}: no CRDs in {' or '.join(_CRD_FOLDERS)}; have they moved?")
    for source in sources:
        (target / source.name).write_bytes(source.read_bytes())  # copies no read-only mode


def _go(folder: Path, own: dict[str, str], *arguments: str) -> str:
    # The linker strips debug information. Without it the compiler needs a third less disk space.
    flags = "-mod=readonly -modcacherw -gcflags=all=-dwarf=false"
    settings = {"GOTOOLCHAIN": "local", "GOWORK": "off", "CGO_ENABLED": "0", "GOFLAGS": flags}
    # Settings for another system would give programs that do not run on this machine.
    dropped = {"GOOS", "GOARCH", "GOEXPERIMENT", "GO111MODULE"}
    kept = {key: value for key, value in os.environ.items() if key not in dropped}
    done = subprocess.run(
        [*ENDS_WITH_US, "nice", "-n", "19", "go", *arguments],
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
        command = f"go {' '.join(arguments)}"
        raise RigError(f"{folder}: `{command}` failed with {done.returncode}:\n{told}")
    return done.stdout


def _to_stderr(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _main() -> int:
    asked = sys.argv[1:]
    try:
        paths = ensure(needed_with(*asked[1:]) if asked[:1] == ["--for"] else asked or TOOLS)
    except RigError as error:
        print(error, file=sys.stderr)
        return 1
    for name, path in paths.items():
        print(f"{name:24} {path}")
    return 0


if __name__ == "__main__":
    raise SystemExit(_main())
