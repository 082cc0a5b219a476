"""Objects that a GitOps controller created and no longer removes, because it forgot them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from demandops.cluster.health import health_reader
from demandops.cluster.health.release_health import ClusterDomain, History, Target, name_of
from demandops.cluster.object_cache import ObjectCache


@dataclass(frozen=True, slots=True)
class Orphan:
    cluster: str
    kind: str
    namespace: str
    name: str

    @property
    def object(self) -> str:
        return name_of((self.kind, self.namespace, self.name))

    @property
    def command(self) -> str:
        """The command that deletes the object and, for a connection end, also its ConfigMap."""
        names = [f"{self.kind.lower()}/{self.name}"]
        names += [f"configmap/{self.name}"] if self.kind == "Deployment" else []
        return f"kubectl -n {self.namespace} delete --ignore-not-found {' '.join(names)}"

    def __str__(self) -> str:
        return (
            f"{self.object} on cluster '{self.cluster}' belongs to no release any more; an "
            f"administrator of the cluster must delete it: {self.command}"
        )


def orphans(
    domains: Collection[ClusterDomain],
    targets: Iterable[Target],
    commit: str,
    caches: Mapping[str, ObjectCache],
    history: History,
) -> Iterator[Orphan]:
    """Yield the objects that are left on clusters, sorted by cluster, domain and key."""
    needed = {(target.domain, health_reader(target.domain).key(target)) for target in targets}
    for domain in sorted(domains, key=lambda domain: (domain.cluster, domain.name)):
        store = caches.get(domain.cluster)
        if store is None or store.unknown_health(domain):
            continue
        reader, objects = health_reader(domain), store.objects()
        # a controller that has not applied the newest commit may still remove objects
        if not reader.domain_health(domain, commit, objects, history).reaches("reconciled"):
            continue
        for key, item in sorted(objects.items()):
            kind, namespace, name = key
            if (
                namespace == domain.namespace
                and kind in (reader.service_kind, "Deployment")
                and (domain, key) not in needed
                and not item["metadata"].get("deletionTimestamp")
                and reader.applied_by(domain, item)
            ):
                yield Orphan(domain.cluster, kind, namespace, name)
