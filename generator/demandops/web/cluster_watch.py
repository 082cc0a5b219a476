"""Watches the releases on their clusters, and records the changes of their health."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping

from demandops.cluster.bootstrap_status import OldBootstrap, old_bootstraps
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.health import health_reader
from demandops.cluster.health.release_health import ClusterDomain, Target
from demandops.cluster.object_cache import ObjectCache
from demandops.cluster.orphans import Orphan, orphans
from demandops.cluster.release_status import ReleaseStatus, statuses
from demandops.runtime import Runtime
from demandops.staterepo.git.repository import StateRepository
from demandops.web.situation import HealthChange
from demandops.web.views.health_word import word_of

# How many changes of health are kept. They are in memory only, because the page writes nothing.
_KEPT = 2_000


class ClusterWatch:
    """Watches the health of releases on clusters.

    Only one thread at a time may use a watch, but any thread may read :attr:`changes`.
    """

    def __init__(
        self, clusters: Mapping[str, ClusterAccess], on_change: Callable[[], None], runtime: Runtime
    ) -> None:
        self._runtime = runtime
        self._caches = {
            name: ObjectCache(name, access, on_change, runtime)
            for name, access in clusters.items()
            if access.kubeconfig
        }
        self._domains = set[ClusterDomain]()
        self._states: dict[str, str] = {}
        self._unhealthy_from: dict[str, float] = {}
        self._changes = deque[HealthChange](maxlen=_KEPT)

    @property
    def clusters(self) -> frozenset[str]:
        return frozenset(self._caches)

    @property
    def changes(self) -> tuple[HealthChange, ...]:
        """The newest changes of health since the start, oldest first."""
        # any thread may read this; to iterate would fail if the follower appended meanwhile
        return tuple(self._changes.copy())

    def statuses(
        self, targets: Iterable[Target], commit: str, repository: StateRepository
    ) -> dict[str, ReleaseStatus]:
        """Return the status of each release, by the name of the release."""
        # Health is judged by the file that the cluster has applied. Judged by the newest commit,
        # everything would be `waiting` for seconds after each commit.
        targets = list(targets)
        self._watch(target.domain for target in targets)
        reported = statuses(targets, commit, self._caches, repository, repository.changed_paths)
        status_of = {target.name: each for target, each in zip(targets, reported, strict=True)}
        at = self._runtime.monotonic()
        for name, status in status_of.items():
            before, after = self._states.get(name, ""), word_of(status)
            if before == after:
                continue
            self._states[name] = after
            lasted = None
            if after == "healthy":
                began = self._unhealthy_from.pop(name, None)
                lasted = None if began is None else at - began
            elif after != "unknown":
                self._unhealthy_from.setdefault(name, at)
            if before:  # the first health that a cluster reports of a release is no change
                reason = status.health.reason
                change = HealthChange(self._runtime.now(), name, before, after, reason, lasted)
                self._changes.append(change)
        for name in self._states.keys() - status_of.keys():
            del self._states[name]
            self._unhealthy_from.pop(name, None)
        return status_of

    def old_bootstraps(
        self, domains: Collection[ClusterDomain], read: Callable[[str], str | None]
    ) -> tuple[OldBootstrap, ...]:
        """Return the watched clusters that lack the current version of their bootstrap file.

        ``read`` returns the text of a file of the state repo. Access domains that cannot be read
        are left out.
        """
        self._watch(domains)
        return tuple(old_bootstraps(domains, self._caches, read))

    def orphans(
        self,
        domains: Collection[ClusterDomain],
        targets: Iterable[Target],
        commit: str,
        repository: StateRepository,
    ) -> tuple[Orphan, ...]:
        """Return the orphans on the watched clusters: objects whose release is gone.

        Access domains that cannot be read, or that have not applied ``commit``, are left out.
        """
        self._watch(domains)
        return tuple(orphans(domains, targets, commit, self._caches, repository))

    def _watch(self, domains: Iterable[ClusterDomain]) -> None:
        for domain in dict.fromkeys(domains):
            if domain.cluster in self._caches and domain not in self._domains:
                self._domains.add(domain)
                self._caches[domain.cluster].watch(health_reader(domain).objects_to_watch(domain))

    def close(self) -> None:
        for cache in self._caches.values():
            cache.close()
