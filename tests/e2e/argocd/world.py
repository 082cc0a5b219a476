"""A state repo, its generator, and the cluster whose Argo CD follows it.

The cluster is told by nothing but the manifests that `demandops init` laid down for it.
"""

from __future__ import annotations

from pathlib import Path

import yaml

from tests.e2e.common.expected import demand
from tests.e2e.common.ros import Client, Sent
from tests.e2e.common.staterepo import StateRepo
from tests.e2e.common.timing import Times
from tests.e2e.rig.argocd import NAMESPACE
from tests.e2e.rig.cluster import Rig

from .view import Domain


class World(StateRepo):
    """A state repo in use, with its one access domain once a cluster follows it."""

    domain: Domain

    def __init__(self, rig: Rig, folder: Path, ros_domain: int, client: Client) -> None:
        super().__init__(rig, folder, ros_domain, client)
        self._follows = False

    def bootstrap(self, cluster: str) -> None:
        """Put `bootstrap/<cluster>.yaml` on the cluster and wait until its Argo CD follows."""
        manifests = list(yaml.safe_load_all(self.file(f"bootstrap/{cluster}.yaml")))
        (project,) = [item for item in manifests if item["kind"] == "AppProject"]
        (folder,) = [item for item in manifests if item["kind"] == "Application"]
        namespace = folder["spec"]["destination"]["namespace"]
        assert project["spec"]["sourceNamespaces"] == [namespace]
        self.domain = Domain(self.rig.kube, namespace, folder["metadata"]["name"])
        self._follows = True
        self.rig.kube.apply(*manifests)
        self.domain.wait_applied(self.tip())

    def remove(self) -> None:
        """Take the state repo off the cluster. The namespace stays."""
        self.generator.stop()
        if self._follows:
            kube, name = self.rig.kube, self.domain.name
            kube.delete("Application", name, NAMESPACE)
            kube.wait_gone("Application", name, NAMESPACE)
            kube.delete("AppProject", name, NAMESPACE)

    def step(self, number: int, wanted: frozenset[str]) -> Times:
        """Send the goal of a step and follow it to the pods."""
        return self.follow(self.demand(demand(number)), wanted)

    def follow(self, sent: Sent, wanted: frozenset[str]) -> Times:
        """Follow a goal that succeeded until the cluster is exactly as wanted."""
        self.domain.wake()
        fetched = self.domain.wait_fetched(sent.commit)
        applied = self.domain.wait_applied(sent.commit)
        ready = self.domain.wait_lines(wanted)
        pushed = sent.stages["pushed"]
        committed = sent.stages.get("committed", pushed)  # not told where nothing changed
        return Times(sent.at, committed, pushed, fetched, applied, ready)
