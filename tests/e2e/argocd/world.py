"""A state repo, its generator, and the cluster whose Argo CD follows it.

The cluster gets only the manifests that `demandops init` wrote for it.
"""

from __future__ import annotations

import yaml

from tests.e2e.common.staterepo import StateRepo
from tests.e2e.rig.argocd import NAMESPACE

from .view import Domain


class World(StateRepo[Domain]):
    """A state repo that Argo CD follows."""

    def bootstrap(self, cluster: str) -> None:
        """Apply `bootstrap/<cluster>.yaml` to the cluster and wait until its Argo CD follows."""
        manifests = list(yaml.safe_load_all(self.file(f"bootstrap/{cluster}.yaml")))
        (project,) = [item for item in manifests if item["kind"] == "AppProject"]
        (folder,) = [item for item in manifests if item["kind"] == "Application"]
        namespace = folder["spec"]["destination"]["namespace"]
        assert project["spec"]["sourceNamespaces"] == [namespace]
        self.domains[cluster] = Domain(self.rig.kube, namespace, folder["metadata"]["name"])
        self.rig.kube.apply(*manifests)
        self.domain.wait_applied(self.tip())

    def remove(self) -> None:
        """Remove the state repo from the cluster. The namespace stays."""
        self.generator.stop()
        for domain in self.domains.values():
            domain.kube.delete("Application", domain.name, NAMESPACE)
            domain.kube.wait_gone("Application", domain.name, NAMESPACE)
            domain.kube.delete("AppProject", domain.name, NAMESPACE)
