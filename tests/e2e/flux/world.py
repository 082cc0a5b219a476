"""A state repo, its generator, and the clusters whose Flux follows the state repo.

Each cluster gets only the bootstrap file that `demandops init` wrote for it.
"""

from __future__ import annotations

from typing import Any

import yaml

from tests.e2e.common.staterepo import StateRepo
from tests.e2e.rig.cluster import Rig

from .view import SOURCE, Domain


class World(StateRepo[Domain]):
    """A state repo that Flux follows."""

    def bootstrap(self, cluster: str, rig: Rig, **source: Any) -> Domain:
        """Let a cluster follow the state repo, and return the access domain on that cluster.

        `source` replaces fields of the GitRepository's spec in `bootstrap/<cluster>.yaml`, as an
        operator may do with an overlay.
        """
        manifests = list(yaml.safe_load_all(self.file(f"bootstrap/{cluster}.yaml")))
        (git,) = [item for item in manifests if item["kind"] == "GitRepository"]
        git["spec"].update(source)
        (follows,) = [item for item in manifests if item["kind"] == "Kustomization"]
        metadata = follows["metadata"]
        domain = Domain(rig.kube, metadata["namespace"], metadata["name"])
        self.domains[cluster] = domain
        self.apply(rig.kube, manifests)
        domain.wait_applied(self.tip())
        for chart in domain.find("HelmChart"):
            rig.kube.wait_ready("HelmChart", chart["metadata"]["name"], domain.namespace)
        return domain

    def remove(self) -> None:
        self.generator.stop()
        for domain in self.domains.values():
            kube, namespace = domain.kube, domain.namespace
            for kind, name in (("Kustomization", domain.name), ("GitRepository", SOURCE)):
                kube.delete(kind, name, namespace)
                kube.wait_gone(kind, name, namespace)
            for kind in ("HelmRelease", "HelmChart"):  # or the next world loses its own
                kube.wait(f"each {kind} to go", lambda d=domain, k=kind: d.find(k) == [])
        self.remove_wide()
        self.domains.clear()
