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
    health: Health
    seen: str = ""  # the commit that the release's access domain has applied, if that is known
    since: str = ""  # when the state last changed, if that is known

    @property
    def state(self) -> State | Literal["unknown"]:
        # of a cluster that cannot be read, the state is `waiting`, and the reason says so
        return self.health.state if self.seen or self.health.object else "unknown"


_NO_ACCESS = ReleaseStatus(Health("waiting", "no access to this cluster"))


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
        store = caches.get(domain.cluster)
        if store is None:
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
