"""The status of releases as their clusters report it, for the command line and the page."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

from demandops.cluster.health import health_reader
from demandops.cluster.health.release_health import (
    ClusterDomain,
    Health,
    History,
    State,
    Target,
)
from demandops.cluster.object_cache import ObjectCache


@dataclass(frozen=True, slots=True)
class ReleaseStatus:
    """The health of a release, as its cluster reports it.

    ``seen`` is the commit that the release's access domain has applied. ``since`` is the time when
    the state last changed. Both are empty if the cluster does not report them.
    """

    health: Health
    seen: str = ""
    since: str = ""

    @property
    def state(self) -> State | Literal["unknown"]:
        """The state of the release; ``unknown`` without access to the cluster.

        If the cluster cannot be read, the state is ``waiting``, and the reason says so.
        """
        return self.health.state if self.seen or self.health.object else "unknown"


_NO_ACCESS = ReleaseStatus(Health("waiting", "no access to this cluster"))


ChangedPaths = Callable[[str, str], "Collection[str] | None"]
"""A function of two commits that returns the paths in which they differ; None if unknown."""


def statuses(
    targets: Iterable[Target],
    commit: str,
    caches: Mapping[str, ObjectCache],
    history: History,
    changed: ChangedPaths = lambda seen, commit: None,
) -> list[ReleaseStatus]:
    """Return the status of each release at a commit, from the caches of the clusters.

    ``changed`` returns the paths in which two commits differ. If a cluster has applied only an
    earlier commit and reports no failure to apply the new one, each release whose file is not among
    these paths counts as applied. So a new commit does not hide the health of unchanged releases.
    """
    changed = cache(changed)
    known = _CachedHistory(history)
    objects = {name: store.objects() for name, store in caches.items()}
    unread: dict[ClusterDomain, Health | None] = {}
    found = []
    for target in targets:
        domain = target.domain
        store = caches.get(domain.cluster)
        if store is None:
            found.append(_NO_ACCESS)
            continue
        if domain not in unread:
            unread[domain] = store.unknown_health(domain)
        if reason := unread[domain]:
            found.append(ReleaseStatus(reason))
            continue
        read, there = health_reader(domain), objects[domain.cluster]
        health, seen = read.health(target, commit, there, known), read.applied_commit(domain, there)
        if health.state == "waiting" and not health.failing and seen:
            paths = changed(seen, commit)
            if paths is not None and not _is_among(paths, target):
                health = read.release_health(target, seen, there, known)
        found.append(ReleaseStatus(health, seen, read.last_transition(target, there)))
    return found


def _is_among(paths: Collection[str], target: Target) -> bool:
    end = f"/{target.name}.yaml"
    return any(path.endswith(end) for path in paths)


class _CachedHistory:
    """Caches the answers of a history, because all releases of a domain ask the same questions."""

    def __init__(self, history: History) -> None:
        self.includes = cache(history.includes)
        self.unchanged = cache(history.unchanged)
