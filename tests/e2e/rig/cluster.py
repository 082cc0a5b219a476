"""A cluster with Flux or Argo CD, fake nodes and a Git server.

    with Rig("edge", folder, nodes=["edge"]) as rig:
        rig.kube.apply(...)

Only this module knows the order in which the parts start.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from . import RigError, githttp, pki, tools
from .components import Components, prerequisites
from .kube import Kube, Manifest, build_manifest
from .net import answers, free_port, url
from .processes import Component, Processes

Gitops = Literal["flux", "argocd"]

NODE_ID_LABEL = "node_id"  # releases select nodes by it
_CAPACITY = {"cpu": "64", "memory": "256Gi", "ephemeral-storage": "1Ti", "pods": "1000"} | {
    "nvidia.com/gpu": "8"
}


class Rig:
    """A cluster; several can run at once, each with its own ports and folder.

    Args:
        name: the cluster's name in the kubeconfig.
        folder: what it keeps: data, logs, and the repositories of its Git server.
        gitops: the GitOps controller.
        beside: a second GitOps controller.
        nodes: the ids of the nodes.
        git_of: another rig, whose repositories a Git server of this rig serves too, so that two
            clusters read one repo, each by a link of its own.
        report: a function that shows the progress.
    """

    kube: Kube
    kubeconfig: Path
    parts: Processes

    def __init__(
        self,
        name: str,
        folder: Path,
        *,
        gitops: Gitops = "flux",
        beside: Gitops | None = None,
        nodes: Iterable[str] = (),
        git_of: Rig | None = None,
        report: tools.Report | None = None,
    ) -> None:
        self.name, self.gitops, self._folder = name, gitops, folder
        self._controllers = tuple(dict.fromkeys([gitops, beside or gitops]))
        self._report = report
        self._repositories = (git_of or self)._folder / "git"
        self._nodes = [_fake_node(node_id) for node_id in nodes]
        self._binaries: dict[str, Path] = {}
        self._git_url = ""

    def __enter__(self) -> Rig:
        """Start everything and wait until it is ready; stop everything on failure."""
        try:
            self._start()
            self.kube.apply(*self._nodes)
            for node in self._nodes:
                self.kube.wait_ready("Node", node["metadata"]["name"])
        except BaseException:  # also after an interrupt
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        if hasattr(self, "kube"):
            self.kube.close()
        if hasattr(self, "parts"):
            self.parts.stop_all()

    # --- what tests use ---------------------------------------------------------------------

    def git_url(self, repository: str) -> str:
        return f"{self._git_url}/{repository}"

    def repository(self, name: str) -> Path:
        return self._repositories / name

    def helm(self, *arguments: str) -> str:
        environment = self._environment() | {"KUBECONFIG": str(self.kubeconfig)}
        command = [str(self.helm_program), *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RigError(f"helm {' '.join(arguments)}: {done.stderr.strip()}")
        return done.stdout

    @property
    def helm_program(self) -> Path:
        return self._binaries["helm"]

    # --- starting ---------------------------------------------------------------------------

    def _start(self) -> None:
        self._binaries = tools.ensure(tools.needed_with(*self._controllers), self._report)
        folder, port = self._folder, free_port()
        self._git_url = url(port)
        running = self.parts = Processes(folder / "logs", self._environment())
        certificates = pki.make(folder / "pki")
        parts = Components(self._binaries, folder, certificates)
        running.start_together([*parts.of("store"), git_server("git", self._repositories, port)])
        running.start_together(parts.of("api"))
        self.kubeconfig, server = parts["kubeconfig"], url(parts["api_port"], "https")
        pki.write_kubeconfig(self.kubeconfig, self.name, server, certificates)
        self.kube = Kube(self.kubeconfig, folder / "discovery.json", running.check)
        self.kube.install_crds(tools.crd_files(self._binaries))
        started = [*parts.of("control")]
        for controller in self._controllers:
            self.kube.apply(*prerequisites(controller))
            started += parts.of(controller)
        running.start_together(started)
        # A namespace accepts no pods until the controller manager has created its account.
        account = ("ServiceAccount", "default", "default")
        self.kube.wait("the default service account", lambda: self.kube.get(*account))

    def _environment(self) -> dict[str, str]:
        """Return the environment of the rig's processes, which read no file of the user."""
        home, temporary = self._folder / "home", self._folder / "tmp"
        for place in (home, temporary):
            place.mkdir(exist_ok=True)
        return {
            "PATH": os.environ.get("PATH", os.defpath),
            "HOME": str(home),
            "TMPDIR": str(temporary),
            "NO_PROXY": "127.0.0.1,localhost",
        }


def git_server(
    name: str, root: Path, port: int, environment: Mapping[str, str] | None = None
) -> Component:
    arguments = ("--root", str(root), "--port", str(port))
    argv = (sys.executable, "-I", "-S", githttp.__file__, *arguments)
    return Component(name, argv, answers(port, githttp.HEALTH), environment or {})


def _fake_node(node_id: str) -> Manifest:
    """Return a node that kwok reports as running, with its pods; the annotation says so."""
    status = {"capacity": _CAPACITY, "allocatable": _CAPACITY}
    made = build_manifest("v1", "Node", node_id, status=status)
    made["metadata"] |= {
        "labels": {
            "kubernetes.io/hostname": node_id,
            "kubernetes.io/os": "linux",
            "type": "kwok",
            NODE_ID_LABEL: node_id,
        },
        "annotations": {"kwok.x-k8s.io/node": "fake", "node.alpha.kubernetes.io/ttl": "0"},
    }
    return made
