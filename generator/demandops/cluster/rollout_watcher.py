"""What came of demands: follows releases on their clusters until they are as far as asked.

One thread looks at what is followed whenever a watch brings news. A cluster that is away holds up
those who wait for it and nobody else.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

from demandops.cluster.access import ClusterAccess
from demandops.cluster.health import (
    ClusterDomain,
    Health,
    History,
    Level,
    Objects,
    Target,
    health_reader,
    worst,
)
from demandops.cluster.object_cache import ObjectCache

log = logging.getLogger("demandops")

OnProgress = Callable[[str, str], None]
"""Called with a state (``reconciled``, ``healthy``, ``failing``) and a text, once for each news."""

_QUIET_S = 0.05
_LONGEST_S = 1.0


@dataclass(eq=False)
class _Followed:
    commit: str
    domains: tuple[ClusterDomain, ...]
    targets: tuple[Target, ...]
    level: Level
    deadline: float
    told: OnProgress
    future: Future[Health] = field(default_factory=Future)
    said: set[str] = field(default_factory=set)
    failed: Health | None = None
    confirmed: bool = False
    busy: bool = False


class RolloutWatcher:
    """Watches clusters, as many as the operator's file names."""

    def __init__(self, clusters: Mapping[str, ClusterAccess], history: History) -> None:
        """Start with no watch; those of a place begin when something there is followed.

        Args:
            clusters: how each cluster is reached; those without a kubeconfig tell nothing.
            history: the commits of the state repo; asked from the status thread.
        """
        self._history = history
        self._news = threading.Event()
        self._closed = False
        self._lock = threading.Lock()
        self._open: list[_Followed] = []
        self._stores = {
            name: ObjectCache(name, reached, self._news.set)
            for name, reached in clusters.items()
            if reached.kubeconfig
        }
        self._thread = threading.Thread(target=self._run, name="demandops-status", daemon=True)
        self._thread.start()

    def why_unreachable(self, domains: Iterable[ClusterDomain]) -> str:
        """Return why something at these domains cannot be followed; empty where it can."""
        missing = sorted({domain.cluster for domain in domains} - set(self._stores))
        return f"no access to cluster {', '.join(missing)}" if missing else ""

    def follow(
        self,
        commit: str,
        targets: Iterable[Target],
        level: Level,
        timeout: float,
        told: OnProgress = lambda state, text: None,
    ) -> Future[Health]:
        """Follow releases of a published commit; returns at once.

        Args:
            commit: the commit that holds what is asked.
            targets: the releases; all at domains that :meth:`reaches`.
            level: how far they must be.
            timeout: seconds until it is answered anyway.
            told: called with each news, from the status thread.

        Returns:
            A future that gives the health once it reaches ``level``, or at the end of the timeout
            with the reason why it did not.
        """
        targets = tuple(targets)
        domains = tuple(dict.fromkeys(target.domain for target in targets))
        followed = _Followed(commit, domains, targets, level, time.monotonic() + timeout, told)
        for domain in domains:
            self._stores[domain.cluster].watch(health_reader(domain).objects_to_watch(domain))
        with self._lock:
            self._open.append(followed)
        self._news.set()
        return followed.future

    def close(self) -> None:
        """Stop; what is still followed is answered with what is known."""
        self._closed = True
        self._news.set()
        self._thread.join(5)
        for store in self._stores.values():
            store.close()

    def _run(self) -> None:
        while not self._closed:
            self._news.wait(_LONGEST_S)
            self._news.clear()
            self._look()
            time.sleep(_QUIET_S)  # news come in swarms
        self._look(last=True)

    def _look(self, last: bool = False) -> None:
        with self._lock:
            followed = list(self._open)
        if not followed:
            return
        objects = {name: store.objects() for name, store in self._stores.items()}
        for one in followed:
            if one.busy and not last:
                continue
            health = self._health(one, objects)
            if health.reaches("healthy") and not (one.confirmed or last):
                self._beside(one, self._confirm)
                continue
            self._tell(one, health)
            one.failed = health if health.failing else one.failed
            if health.reaches(one.level) or last:
                self._answer(one, health)
            elif time.monotonic() > one.deadline:
                self._beside(one, partial(self._give_up, health=health))

    def _beside(self, one: _Followed, work: Callable[[_Followed], None]) -> None:
        """Ask a cluster in a thread of its own, for it may not answer."""
        one.busy = True

        def run() -> None:
            try:
                work(one)
            except Exception as error:
                log.debug("a cluster did not answer: %s", error)
            one.busy = False
            self._news.set()

        threading.Thread(target=run, name="demandops-status-ask", daemon=True).start()

    def _confirm(self, one: _Followed) -> None:
        for domain in one.domains:
            self._stores[domain.cluster].refresh(health_reader(domain).objects_to_confirm(domain))
        one.confirmed = True

    def _give_up(self, one: _Followed, health: Health) -> None:
        """Answer at the end of the timeout, with what the pods say where a Deployment hangs.

        Where it is just being tried again, what failed before is the reason.
        """
        failed = one.failed
        if failed and not health.failing and failed.object == health.object:
            health = replace(health, reason=f"{health.reason}; before: {failed.reason}")
        kind, _, name = health.object.partition(" ")
        if kind == "Deployment":
            namespace, _, deployment = name.partition("/")
            with suppress(Exception):
                for target in one.targets:
                    if target.domain.namespace == namespace:
                        store = self._stores[target.domain.cluster]
                        why = store.why_unavailable(namespace, deployment)
                        if why:
                            health = replace(health, reason=f"{health.reason}; {why}")
                            break
        self._answer(one, health)

    def _answer(self, one: _Followed, health: Health) -> None:
        with self._lock:
            if one not in self._open:
                return
            self._open.remove(one)
        one.future.set_result(health)

    def _health(self, one: _Followed, objects: Mapping[str, Objects]) -> Health:
        domains = [self._of_place(domain, one.commit, objects) for domain in one.domains]
        found = worst(domains)
        if found.state == "waiting" or not one.domains:
            return found
        return worst([self._of_target(target, one.commit, objects) for target in one.targets])

    def _of_place(
        self, domain: ClusterDomain, commit: str, objects: Mapping[str, Objects]
    ) -> Health:
        read = health_reader(domain)
        unread = self._stores[domain.cluster].why_unknown(read.objects_to_watch(domain))
        if unread:
            return Health("waiting", f"cannot be read: {unread}", f"cluster {domain.cluster}")
        return read.domain_health(domain, commit, objects[domain.cluster], self._history)

    def _of_target(self, target: Target, commit: str, objects: Mapping[str, Objects]) -> Health:
        found = objects[target.domain.cluster]
        return health_reader(target.domain).release_health(target, commit, found, self._history)

    @staticmethod
    def _tell(one: _Followed, health: Health) -> None:
        reached = [level for level in ("reconciled", "healthy") if health.reaches(level)]
        news = [(level, level) for level in reached]
        if health.failing:
            news.append(("failing", f"{health.object}: {health.reason}"))
        for state, text in news:
            if text not in one.said:
                one.said.add(text)
                one.told(state, text)
