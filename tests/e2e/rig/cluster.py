"""A cluster with Flux or Argo CD, fake nodes and a Git server.

    with Rig("edge", nodes=["edge"]) as rig:
        rig.kube.apply(...)

Only this module knows the order in which the parts start. If the environment names an existing
cluster (see `settings`), the rig starts nothing and represents that cluster.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Literal

from tests.kit.limits import PATIENCE_S

from . import argocd, flux, githttp, kwok, pki, settings, tools
from .controlplane import ControlPlane
from .errors import RigError
from .kube import Kube
from .net import answers, free_port, url
from .processes import Component, Processes
from .workdir import Workdir

KEEP_VARIABLE = "E2E_KEEP"

Gitops = Literal["flux", "argocd"]

PARTS: dict[Gitops, ModuleType] = {"flux": flux, "argocd": argocd}


class Rig:
    """A cluster; several can run at once, each with its own ports and folder.

    Args:
        name: the rig's name, as in E2E_KUBECONFIG_<NAME>.
        gitops: the GitOps controller.
        beside: a second GitOps controller.
        nodes: the ids of the nodes at the start.
        git_of: another rig, whose Git server this rig uses, so that two clusters read one repo.
        credentials: the user and the password that the Git server requires.
        arguments: additional arguments of controllers, by the controller's name.
        folder: the folder of data and logs. The default is a temporary folder, which the rig
            removes at the end unless E2E_KEEP is set; after a failure, the logs stay.
        report: a function that shows the progress.
    """

    kube: Kube
    kubeconfig: Path

    def __init__(
        self,
        name: str = "rig",
        *,
        gitops: Gitops = "flux",
        beside: Gitops | None = None,
        nodes: Iterable[str] = (),
        git_of: Rig | None = None,
        credentials: tuple[str, str] | None = None,
        arguments: Mapping[str, Iterable[str]] | None = None,
        folder: Path | None = None,
        report: tools.Report | None = None,
    ) -> None:
        self.name, self.gitops = name, gitops
        self._controllers = tuple(dict.fromkeys([gitops, beside or gitops]))
        self.timings: dict[str, float] = {}
        self.existing = settings.existing(name)
        self._initial, self._git_of, self._credentials = list(nodes), git_of, credentials
        self._arguments = {key: list(value) for key, value in (arguments or {}).items()}
        self._report, self._folder = report, folder
        self._nodes: list[str] = []
        self._binaries: dict[str, Path] = {}
        self._work: Workdir | None = None
        self._processes: Processes | None = None
        self._git_url = self._push_url = ""

    def __enter__(self) -> Rig:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop(failed=kind is not None)

    # --- start and stop ---------------------------------------------------------------------

    def start(self) -> None:
        """Start everything and wait until it is ready; stop everything on failure."""
        if self._work is not None:
            raise RigError(f"rig {self.name}: already started; stop it first")
        try:
            if self.existing:
                self._adopt(self.existing)
            else:
                self._start_own()
            self.add_nodes(self._initial)
        except BaseException as error:  # also after an interrupt
            self.stop(failed=isinstance(error, Exception))
            raise

    def stop(self, *, failed: bool = False) -> None:
        """Stop everything; keep the logs if `failed`. A second call is allowed."""
        work, processes, kube = self._work, self._processes, getattr(self, "kube", None)
        try:
            if kube is not None and self.existing:
                for name in self._nodes:  # a cluster that the rig started goes as a whole
                    kube.delete("Node", name)
            if kube is not None:
                kube.close()
        finally:
            self._work = self._processes = None
            self._nodes = []
            if processes is not None:
                processes.stop_all()
            if work is not None:
                self._clear(work, failed)

    def check(self) -> None:
        """Raise RigError if a part has died without being stopped."""
        if self._processes is not None:
            self._processes.check()

    # --- what tests use ---------------------------------------------------------------------

    def git_url(self, repository: str) -> str:
        """Return the URL by which the cluster reads a repository (`state.git`)."""
        return f"{self._git_url}/{repository.strip('/')}"

    def push_url(self, repository: str) -> str:
        """Return the URL by which a test pushes to a repository, with credentials."""
        return f"{self._push_url}/{repository.strip('/')}"

    def repository(self, repository: str) -> Path:
        """Return the folder of a bare repository; create the repository if it is missing."""
        path = self._owned("has no repositories on this disk").repositories / repository.strip("/")
        if self._git_of is not None:
            return self._git_of.repository(repository)
        if not path.exists():
            githttp.init_bare(path)
        return path

    def add_nodes(self, node_ids: Iterable[str], timeout: float = PATIENCE_S) -> list[str]:
        """Create fake nodes with these `node_id` labels; return their names once all are Ready."""
        manifests = [kwok.manifest(node_id) for node_id in node_ids]
        names = [manifest["metadata"]["name"] for manifest in manifests]
        self._nodes += names
        self.kube.apply(*manifests)
        for name in names:
            self.kube.wait_ready("Node", name, timeout=timeout)
        return names

    def helm(self, *arguments: str) -> str:
        """Run the helm command on this cluster and return what it prints."""
        helm = self.helm_program()
        # The kubeconfig of an existing cluster may call a login command that needs the environment.
        clean = self._work.environment() if self._work and not self.existing else dict(os.environ)
        environment = clean | {"KUBECONFIG": str(self.kubeconfig)}
        done = subprocess.run(
            [str(helm), *arguments], env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            raise RigError(f"helm {' '.join(arguments)}: {done.stderr.strip()}")
        return done.stdout

    def helm_program(self) -> Path:
        """Return the path of the helm command; build it first if it is missing."""
        found = self._binaries.get("helm") or shutil.which("helm")
        if found is None:
            found = self._binaries["helm"] = tools.ensure(["helm"], self._report)["helm"]
        return Path(found)

    # --- single parts -----------------------------------------------------------------------

    def components(self) -> list[str]:
        """Return the names of the parts that a test can kill and start again."""
        return self._own().names()

    def pids(self) -> dict[str, int]:
        return self._own().pids()

    def log(self, component: str) -> Path:
        return self._own().log(component)

    def url(self, component: str) -> str:
        """Return the URL at which tests call a component."""
        return self._own().url(component)

    def kill(self, component: str) -> None:
        """Kill a component, as a crash would; `start_component` starts it again."""
        self._own().kill(component)

    def stop_component(self, component: str) -> None:
        """Ask a component to end, and kill it if it does not end."""
        self._own().stop(component)

    def start_component(self, component: str) -> None:
        """Start a component again, on the same ports and data, and wait until it is ready."""
        self._own().start(component)

    def restart(self, component: str) -> None:
        self.stop_component(component)
        self.start_component(component)

    def pause(self, component: str) -> None:
        """Pause a component: it accepts connections and never answers."""
        self._own().signal(component, signal.SIGSTOP)

    def resume(self, component: str) -> None:
        self._own().signal(component, signal.SIGCONT)

    # --- starting ---------------------------------------------------------------------------

    def _adopt(self, existing: settings.Existing) -> None:
        self.kubeconfig = existing.kubeconfig
        self._git_url, self._push_url = existing.git_url, existing.push_url
        work = self._work = Workdir(self.name, self._folder)
        self.kube = Kube(existing.kubeconfig, work.path / "discovery.json")
        for controller in self._controllers:
            kinds, remedy = PARTS[controller].KINDS, PARTS[controller].REMEDY
            for kind in kinds:
                try:
                    self.kube.find(kind)
                except Exception as error:
                    where = existing.kubeconfig
                    raise RigError(f"{where}: no {kind}s: {error}; {remedy}") from error

    def _start_own(self) -> None:
        clock = _Clock(self.timings)
        self._binaries = tools.ensure(tools.needed_with(*self._controllers), self._report)
        clock.lap("tools")
        work = self._work = Workdir(self.name, self._folder)
        running = self._processes = Processes(work.logs, work.environment())
        certificates = pki.make(work.path / "pki")
        plane = ControlPlane.plan(self._binaries, work.path, certificates)
        running.start_together([plane.etcd(), *self._git(work)])
        clock.lap("etcd and git")
        running.start_together([plane.apiserver()])
        clock.lap("kube-apiserver")
        path = work.path / "kubeconfig"
        self.kubeconfig = pki.write_kubeconfig(path, self.name, plane.server, certificates)
        self.kube = Kube(self.kubeconfig, work.path / "discovery.json", self.check)
        self.kube.install_crds(tools.crd_files(self._binaries))
        parts = [PARTS[controller] for controller in self._controllers]
        for part in parts:
            self.kube.apply(*part.prerequisites())
        clock.lap("CRDs and settings")
        running.start_together(
            [
                plane.controller_manager(path),
                plane.scheduler(path),
                kwok.component(self._binaries["kwok"], path, certificates),
                *(
                    component
                    for part in parts
                    for component in part.components(
                        self._binaries, work.path, path, self._arguments
                    )
                ),
            ]
        )
        # A namespace accepts no pods until the controller manager has created its account.
        account = ("ServiceAccount", "default", "default")
        self.kube.wait("the default service account", lambda: self.kube.get(*account))
        clock.lap("controllers")

    def _git(self, work: Workdir) -> list[Component]:
        if self._git_of is not None:
            self._git_url, self._push_url = self._git_of._git_url, self._git_of._push_url
            return []
        port = free_port()
        self._git_url = self._push_url = url(port)
        environment: dict[str, str] = {}
        if self._credentials is not None:
            user, password = self._credentials
            environment = {githttp.USER_VARIABLE: user, githttp.PASSWORD_VARIABLE: password}
            self._push_url = self._git_url.replace("://", f"://{user}:{password}@", 1)
        argv = [sys.executable, "-I", "-S", githttp.__file__]
        argv += ["--root", str(work.repositories), "--port", str(port)]
        return [Component("git", tuple(argv), answers(port, githttp.HEALTH), environment)]

    # --- inside -----------------------------------------------------------------------------

    def _own(self) -> Processes:
        if self._processes is None:
            raise RigError(
                f"rig {self.name}: has no processes; it is not started or uses an existing cluster"
            )
        return self._processes

    def _owned(self, what: str) -> Workdir:
        if self._work is None or self.existing:
            raise RigError(f"rig {self.name}: {what}")
        return self._work

    def _clear(self, work: Workdir, failed: bool) -> None:
        if os.environ.get(KEEP_VARIABLE):
            print(f"rig {self.name}: kept {work.path}", file=sys.stderr)
            return
        work.clear(keep_logs=failed)
        if failed and not self.existing:
            print(f"rig {self.name}: logs are in {work.logs}", file=sys.stderr)


class _Clock:
    def __init__(self, timings: dict[str, float]) -> None:
        self._timings, self._last = timings, time.monotonic()

    def lap(self, stage: str) -> None:
        now = time.monotonic()
        self._timings[stage] = round(now - self._last, 2)
        self._last = now


def start_all(*rigs: Rig) -> None:
    """Start several rigs at the same time; if one fails, stop all."""
    try:
        with ThreadPoolExecutor(max_workers=len(rigs)) as pool:
            for job in [pool.submit(rig.start) for rig in rigs]:
                job.result()
    except BaseException:
        for rig in rigs:
            rig.stop(failed=True)
        raise
