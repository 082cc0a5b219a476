"""Build the rig's programs from pinned Go modules, once, into a cache outside the checkout.

The other modules of the rig take the paths that `ensure` returns. Each program is pinned by a Go
module of its own under `tests/e2e/tools/`, whose `go.sum` covers all dependencies.

The name of a cache entry is a digest of everything that decides the program's bytes. A finished
entry is renamed into the cache, so each existing entry is complete.

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
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from . import gobuild
from .errors import RigError

WRAPPERS = Path(__file__).resolve().parent.parent / "tools"
CACHE_VARIABLE = "DEMANDOPS_E2E_CACHE"

Report = Callable[[str], None]

_ARGOCD = "github.com/argoproj/argo-cd/v3"
_CRD_FOLDERS = ("config/crd/bases", "manifests/crds")  # Flux's, Argo CD's


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
    wanted, say = list(names), report or _to_stderr
    go = gobuild.Go.find()
    entries = {name: cache_root() / f"{name}-{_digest(TOOLS[name], go)}" for name in wanted}
    missing = [name for name in wanted if not entries[name].is_dir()]
    for place, name in enumerate(missing, start=1):
        with _turn(cache_root(), say):
            if not entries[name].is_dir():  # another run may have built it while we waited
                workspace = gobuild.Workspace(cache_root() / f".go-{TOOLS[name].wrapper}")
                say(f"building program {place} of {len(missing)}, {name}")
                _build(TOOLS[name], go, entries[name], workspace, say)
                if TOOLS[name].wrapper not in [TOOLS[other].wrapper for other in missing[place:]]:
                    workspace.remove()
    return {name: entries[name] / name for name in wanted}


def needed_with(*gitops: str) -> list[str]:
    return [tool.name for tool in TOOLS.values() if tool.gitops in ("", *gitops)]


def crd_files(binaries: dict[str, Path]) -> list[Path]:
    return sorted(
        path for binary in binaries.values() for path in binary.parent.glob("crds/*.yaml")
    )


def cache_root() -> Path:
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named).expanduser().resolve()
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser().resolve() / "demandops" / "e2e"


def _digest(tool: Tool, go: gobuild.Go) -> str:
    """Return a digest of what decides a program's bytes: pins, flags, toolchain and target."""
    folder = WRAPPERS / tool.wrapper
    parts = [
        (folder / "go.mod").read_bytes(),
        (folder / "go.sum").read_bytes(),
        json.dumps([tool.package, tool.crds_of, _flags(tool), go.version, go.target]).encode(),
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
        for leftover in root.glob(".building-*"):  # only of killed builds, as we hold the lock
            shutil.rmtree(leftover, ignore_errors=True)
        yield


def _build(
    tool: Tool, go: gobuild.Go, entry: Path, workspace: gobuild.Workspace, say: Report
) -> None:
    staging = Path(tempfile.mkdtemp(prefix=f".building-{tool.name}-", dir=entry.parent))
    try:
        start, wrapper, binary = time.monotonic(), WRAPPERS / tool.wrapper, staging / tool.name
        go.check(wrapper)
        say("fetching modules")
        workspace.vendor(go, wrapper)
        if tool.crds_of:
            _copy_crds(Path(gobuild.module_folder(go, workspace, tool.crds_of)), staging / "crds")
        workspace.drop_modules()
        gobuild.build(go, tool.package, _flags(tool), binary, workspace, say)
        with binary.open("rb") as written:
            os.fsync(written.fileno())  # otherwise a power cut could leave an empty file
        staging.chmod(0o755)
        staging.rename(entry)
        say(f"built in {time.monotonic() - start:.0f} s")
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _copy_crds(module: Path, target: Path) -> None:
    target.mkdir()
    found = (path for folder in _CRD_FOLDERS for path in (module / folder).glob("*.yaml"))
    sources = sorted(path for path in found if path.name != "kustomization.yaml")
    if not sources:
        raise RigError(f"{module}: no CRDs in {' or '.join(_CRD_FOLDERS)}; have they moved?")
    for source in sources:
        (target / source.name).write_bytes(source.read_bytes())  # copies no read-only mode


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
