"""Finds the clusters whose bootstrap file is older than the one in the state repo."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from demandops.cluster.health import health_reader
from demandops.cluster.health.release_health import ClusterDomain
from demandops.cluster.object_cache import ObjectCache
from demandops.render.gitops.bootstrap_digest import digest_in, digest_of
from demandops.render.gitops.paths import bootstrap_path


@dataclass(frozen=True, slots=True)
class OldBootstrap:
    cluster: str
    file: str
    domains: tuple[str, ...]  # whose objects are old or missing
    command: str

    def __str__(self) -> str:
        return (
            f"cluster '{self.cluster}' does not have the current {self.file} (access domains: "
            f"{', '.join(self.domains)}); an administrator of the cluster must apply it: "
            f"{self.command}"
        )


def old_bootstraps(
    domains: Collection[ClusterDomain],
    caches: Mapping[str, ObjectCache],
    read: Callable[[str], str | None],
) -> list[OldBootstrap]:
    """Return the clusters without the current bootstrap file; skip domains that cannot be read."""
    clusters = []
    for cluster in sorted({domain.cluster for domain in domains} & caches.keys()):
        path = bootstrap_path(cluster)
        digest = digest_in(read(path) or "")
        store, objects = caches[cluster], caches[cluster].objects()
        old = tuple(
            domain.name
            for domain in domains
            if domain.cluster == cluster
            and store.unknown_health(domain) is None
            and digest_of(objects.get(health_reader(domain).follower(domain)) or {}) != digest
        )
        if digest and old:
            command = f"git show main:{path} | kubectl apply -f -"
            clusters.append(OldBootstrap(cluster, path, old, command))
    return clusters
