"""A state repo, its generator, and the cluster whose Argo CD follows the state repo.

The cluster gets only the bootstrap file that `demandops init` wrote for it.
"""

from __future__ import annotations

import yaml

from tests.e2e.common.staterepo import StateRepo
from tests.e2e.rig.argocd import NAMESPACE
from tests.e2e.rig.cluster import Rig

from .view import Domain


class World(StateRepo[Domain]):
    """A state repo that Argo CD follows."""

    def bootstrap(self, cluster: str, rig: Rig) -> Domain:
        manifests = list(yaml.safe_load_all(self.file(f"bootstrap/{cluster}.yaml")))
        (project,) = [item for item in manifests if item["kind"] == "AppProject"]
        (folder,) = [item for item in manifests if item["kind"] == "Application"]
        namespace = folder["spec"]["destination"]["namespace"]
        assert project["spec"]["sourceNamespaces"] == [namespace]
        domain = self.domains[cluster] = Domain(rig.kube, namespace, folder["metadata"]["name"])
        self.apply(rig.kube, manifests)

        def is_permitted() -> bool:
            """Return whether the project permits the folder and Argo CD has read the folder.

            For minutes, Argo CD may still use a former project of the same name. If that project
            forbids the folder, make Argo CD look at the folder again.
            """
            trouble = domain.trouble(domain.name, NAMESPACE)
            if "is not permitted in project" in trouble:
                domain.wake()
                return False
            return bool(domain.fetched())

        rig.kube.wait("Argo CD to see the project", is_permitted)
        domain.wait_applied(self.tip())
        return domain

    def remove(self) -> None:
        self.generator.stop()
        for domain in self.domains.values():
            domain.kube.delete("Application", domain.name, NAMESPACE)
            # if a test killed the API server, Argo CD sees this only when it watches again
            domain.kube.wait_gone("Application", domain.name, NAMESPACE, timeout=180.0)
            domain.kube.delete("AppProject", domain.name, NAMESPACE)
        self.remove_wide()
