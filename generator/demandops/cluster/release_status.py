"""What the clusters report: old bootstrap files, forgotten objects, the status of releases."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

from demandops.cluster.health import (
    ClusterDomain,
    Health,
    History,
    State,
    Target,
    health_reader,
    name_of,
)
from demandops.cluster.object_cache import ObjectCache
from demandops.render.gitops import bootstrap_path, digest_in, digest_of

# ---- bootstrap files that are older on a cluster than in the state repo ----


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


# ---- objects that a GitOps controller created and forgot, so that it never removes them ----


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


# ---- the status of releases, for the command line and the page ----


@dataclass(frozen=True, slots=True)
class ReleaseStatus:
    health: Health
    seen: str = ""  # the commit that the release's access domain has applied, if that is known
    since: str = ""  # when the state last changed, if that is known

    @property
    def state(self) -> State | Literal["unknown"]:
        # of a cluster that cannot be read, the state is `waiting`, and the reason says so
        return self.health.state if self.seen or self.health.object else "unknown"


_NO_ACCESS = ReleaseStatus(Health("waiting"))
# Returns the paths in which two commits differ, if that is known.
ChangedPaths = Callable[[str, str], "Collection[str] | None"]


def statuses(
    targets: Iterable[Target],
    commit: str,
    caches: Mapping[str, ObjectCache],
    history: History,
    changed: ChangedPaths = lambda seen, commit: None,
) -> list[ReleaseStatus]:
    changed = cache(changed)
    history = _CachedHistory(history)
    objects = {name: store.objects() for name, store in caches.items()}
    unread: dict[ClusterDomain, Health | None] = {}
    results = []
    for target in targets:
        domain = target.domain
        if (store := caches.get(domain.cluster)) is None:
            results.append(_NO_ACCESS)
            continue
        if domain not in unread:
            unread[domain] = store.unknown_health(domain)
        if reason := unread[domain]:
            results.append(ReleaseStatus(reason))
            continue
        reader, there = health_reader(domain), objects[domain.cluster]
        health = reader.health(target, commit, there, history)
        seen = reader.applied_commit(domain, there)
        # A new commit must not hide the health of the releases that it does not change. So they
        # count as applied while the controller still works on the commit.
        if health.state == "waiting" and not health.failing and seen:
            paths, end = changed(seen, commit), f"/{target.name}.yaml"
            if paths is not None and not any(path.endswith(end) for path in paths):
                health = reader.release_health(target, seen, there, history)
        results.append(ReleaseStatus(health, seen, reader.last_transition(target, there)))
    return results


class _CachedHistory:
    # all releases of a domain ask the same questions, and each answer reads commits
    def __init__(self, history: History) -> None:
        self.includes = cache(history.includes)
        self.unchanged = cache(history.unchanged)
