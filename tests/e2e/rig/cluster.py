"""A cluster with Flux or Argo CD, fake nodes and a Git server.

    with Rig("edge", nodes=["edge"]) as rig:
        rig.kube.apply(...)

Only this module knows the order in which the parts start. If the environment names an existing
cluster (see `settings`), the rig starts nothing and represents that cluster.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from . import githttp, kwok, pki, settings, tools
from .components import KINDS, Components, prerequisites
from .errors import RigError
from .kube import Kube
from .net import answers, free_port, url
from .processes import Component, Processes
from .workdir import Workdir

KEEP_VARIABLE = "E2E_KEEP"

Gitops = Literal["flux", "argocd"]


class Rig:
    """A cluster; several can run at once, each with its own ports and folder.

    Args:
        name: the rig's name, as in E2E_KUBECONFIG_<NAME>.
        gitops: the GitOps controller.
        beside: a second GitOps controller.
        nodes: the ids of the nodes.
        git_of: another rig, whose repositories a Git server of this rig serves too, so that two
            clusters read one repo, each by a link of its own.
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
        report: tools.Report | None = None,
    ) -> None:
        self.name, self.gitops = name, gitops
        self._controllers = tuple(dict.fromkeys([gitops, beside or gitops]))
        self.existing = settings.existing(name)
        self._git_of, self._report = git_of, report
        self._nodes = [kwok.manifest(node_id) for node_id in nodes]
        self._binaries: dict[str, Path] = {}
        self._work: Workdir | None = None
        self.parts: Any = None
        """The processes of a cluster that this rig has started."""
        self._git_url = self._push_url = ""

    def __enter__(self) -> Rig:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
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
            self.kube.apply(*self._nodes)
            for node in self._nodes:
                self.kube.wait_ready("Node", node["metadata"]["name"])
        except BaseException as error:  # also after an interrupt
            self.stop(failed=isinstance(error, Exception))
            raise

    def stop(self, *, failed: bool = False) -> None:
        """Stop everything; keep the logs if `failed`. A second call is allowed."""
        work, processes, kube = self._work, self.parts, getattr(self, "kube", None)
        try:
            if kube is not None and self.existing:
                for node in self._nodes:  # a cluster that the rig started goes as a whole
                    kube.delete("Node", node["metadata"]["name"])
            if kube is not None:
                kube.close()
        finally:
            self._work = self.parts = None
            if processes is not None:
                processes.stop_all()
            if work is not None:
                self._clear(work, failed)

    def check(self) -> None:
        if self.parts is not None:
            self.parts.check()

    # --- what tests use ---------------------------------------------------------------------

    def git_url(self, repository: str) -> str:
        return f"{self._git_url}/{repository}"

    def push_url(self, repository: str) -> str:
        """Return the URL by which a test pushes to a repository."""
        return f"{self._push_url}/{repository}"

    def repository(self, name: str) -> Path:
        work = (self._git_of or self)._work
        assert work is not None and not self.existing
        return work.repositories / name

    def helm(self, *arguments: str) -> str:
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

    # --- starting ---------------------------------------------------------------------------

    def _adopt(self, existing: settings.Existing) -> None:
        self.kubeconfig = existing.kubeconfig
        self._git_url, self._push_url = existing.git_url, existing.push_url
        work = self._work = Workdir(self.name)
        self.kube = Kube(existing.kubeconfig, work.path / "discovery.json")
        for kind in (kind for controller in self._controllers for kind in KINDS[controller]):
            try:
                self.kube.find(kind)
            except Exception as error:
                remedy = f"set {' and '.join(self._controllers)} up there first, as docs/ says"
                raise RigError(f"{existing.kubeconfig}: no {kind}s: {error}; {remedy}") from error

    def _start_own(self) -> None:
        self._binaries = tools.ensure(tools.needed_with(*self._controllers), self._report)
        work = self._work = Workdir(self.name)
        running = self.parts = Processes(work.logs, work.environment())
        certificates = pki.make(work.path / "pki")
        parts = Components(self._binaries, work.path, certificates)
        running.start_together([*parts.of("store"), self._git()])
        running.start_together(parts.of("api"))
        self.kubeconfig, server = parts["kubeconfig"], url(parts["api_port"], "https")
        pki.write_kubeconfig(self.kubeconfig, self.name, server, certificates)
        self.kube = Kube(self.kubeconfig, work.path / "discovery.json", self.check)
        self.kube.install_crds(tools.crd_files(self._binaries))
        started = [*parts.of("control")]
        for controller in self._controllers:
            self.kube.apply(*prerequisites(controller))
            started += parts.of(controller)
        running.start_together(started)
        # A namespace accepts no pods until the controller manager has created its account.
        account = ("ServiceAccount", "default", "default")
        self.kube.wait("the default service account", lambda: self.kube.get(*account))

    def _git(self) -> Component:
        port = free_port()
        self._git_url = self._push_url = url(port)
        argv = [sys.executable, "-I", "-S", githttp.__file__]
        argv += ["--root", str(self.repository("")), "--port", str(port)]
        return Component("git", tuple(argv), answers(port, githttp.HEALTH))

    # --- inside -----------------------------------------------------------------------------

    def _clear(self, work: Workdir, failed: bool) -> None:
        if os.environ.get(KEEP_VARIABLE):
            print(f"rig {self.name}: kept {work.path}", file=sys.stderr)
            return
        work.clear(keep_logs=failed)
        if failed and not self.existing:
            print(f"rig {self.name}: logs are in {work.logs}", file=sys.stderr)
