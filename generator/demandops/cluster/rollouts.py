"""Follows what a demand needs or removes until it runs, or is gone."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

from demandops.base.errors import Refused
from demandops.base.runtime import REAL, Runtime
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.health import (
    ClusterDomain,
    Health,
    History,
    Level,
    ObjectSelector,
    Target,
    health_reader,
    why_unavailable,
    worst,
)
from demandops.cluster.object_cache import object_caches
from demandops.decide.decision import Decision
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.planning.planner import plan
from demandops.decide.planning.release_keys import affected_keys, keys_of_claims
from demandops.decide.state import State
from demandops.model.config.policy import AccessDomain
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.ledger.claim import ClaimKey, demand_id
from demandops.model.ledger.ledger import World
from demandops.model.release import Release, ServiceRelease
from demandops.render.gitops import domains_in_use, project_of

# ---- the targets whose rollout can be followed ----


def targets_of_decision(before: World, decision: Decision) -> tuple[Target, ...]:
    # of the releases that a demand needs, changes or removes; what only other demands need is left
    # out, even if they share a subject with this one
    after, request = decision.state, decision.request
    active = without_suspended(after)
    claims = [*active.ledger.claims_of_demand(request.demand)]
    for demanded in request.demanded if request.adds_claims else ():
        own = demand_id(request.id, demanded.requesters)  # that of a join
        if claim := active.ledger.get(ClaimKey(demanded.held.subject, own)):
            claims.append(claim)
    changed = affected_keys(before, after, decision.changes.claims)
    targets = []
    for key in dict.fromkeys((*keys_of_claims(active, claims), *changed)):
        new = after.plans.get(key) or plan(after, key)
        try:
            release = new or plan(before, key)
        except Refused:
            continue
        if release is not None:
            targets.append(target_of(release, after.config.repo_settings, wanted=new is not None))
    return tuple(dict.fromkeys(targets))


def domains_of_state(state: State) -> list[ClusterDomain]:
    in_use, settings = domains_in_use(state.config), state.config.repo_settings
    return [cluster_domain(cluster, domain, settings) for cluster, domain in in_use]


def cluster_domain(cluster: str, domain: AccessDomain, repository: RepoSettings) -> ClusterDomain:
    application = None  # with Argo CD, the Application that applies the folder of the domain
    if repository.gitops == "argocd" and repository.argocd:
        name = project_of(domain, repository)
        application = ObjectSelector("Application", repository.argocd.namespace, name)
    return ClusterDomain(cluster, domain.name, domain.namespace, application)


def target_of(release: Release, repository: RepoSettings, *, wanted: bool = True) -> Target:
    domain = cluster_domain(release.node.cluster, release.domain, repository)
    return Target(domain, release.name, isinstance(release, ServiceRelease), wanted)


# ---- following until a release is reconciled or healthy, as requested ----
#
# One thread evaluates the rollouts whenever a watch reports a change. An unreachable cluster delays
# only its own rollouts.

log = logging.getLogger("demandops")

# Called with a state (reconciled, healthy, failing) and a text, once for each text.
OnProgress = Callable[[str, str], None]


@dataclass(eq=False)
class _Rollout:
    commit: str
    domains: tuple[ClusterDomain, ...]
    targets: tuple[Target, ...]
    level: Level
    deadline: float
    on_progress: OnProgress
    future: Future[Health] = field(default_factory=Future)
    reported: set[str] = field(default_factory=set)
    failed: Health | None = None
    confirmed: bool = False
    busy: bool = False


class RolloutWatcher:
    def __init__(
        self, clusters: Mapping[str, ClusterAccess], history: History, runtime: Runtime = REAL
    ) -> None:
        """Start; a domain is watched from its first rollout on, if its cluster has a kubeconfig."""
        self._history, self._runtime = history, runtime
        self._changed = runtime.event()
        self._closed = False
        self._lock = runtime.lock()
        self._open: list[_Rollout] = []
        self._caches = object_caches(clusters, self._changed.set, runtime)
        self._thread = runtime.keep_running("status", self._run)

    def why_unreachable(self, domains: Iterable[ClusterDomain]) -> str:
        missing = sorted({domain.cluster for domain in domains} - set(self._caches))
        return f"no access to cluster {', '.join(missing)}" if missing else ""

    def follow(
        self,
        commit: str,
        targets: Iterable[Target],
        level: Level,
        timeout: float,
        on_progress: OnProgress = lambda state, text: None,
    ) -> Future[Health]:
        # `why_unreachable` must be empty for their domains. The future has the health when it
        # reaches ``level``, or when the time is over or this watcher is closed; it then says why.
        targets = tuple(targets)
        domains = tuple(dict.fromkeys(target.domain for target in targets))
        deadline = self._runtime.monotonic() + timeout
        rollout = _Rollout(commit, domains, targets, level, deadline, on_progress)
        for domain in domains:
            self._caches[domain.cluster].watch(health_reader(domain).objects_to_watch(domain))
        with self._lock:
            self._open.append(rollout)
        self._changed.set()
        return rollout.future

    def close(self) -> None:
        self._closed = True
        self._changed.set()
        self._thread.join(5)
        for cache in self._caches.values():
            cache.close()

    def _run(self) -> None:
        while not self._closed:
            self._changed.wait(1.0)
            self._changed.clear()
            self._evaluate()
            self._runtime.sleep(0.05)  # wait, because changes come in bursts
        self._evaluate(last=True)

    def _evaluate(self, last: bool = False) -> None:
        with self._lock:
            rollouts = list(self._open)
        if not rollouts:
            return
        objects = {name: cache.objects() for name, cache in self._caches.items()}
        for rollout in rollouts:
            if rollout.busy and not last:
                continue
            try:
                healths = list[Health]()
                for target in rollout.targets:
                    domain = target.domain
                    reader, there = health_reader(domain), objects[domain.cluster]
                    healths.append(
                        self._caches[domain.cluster].unknown_health(domain)
                        or reader.health(target, rollout.commit, there, self._history)
                    )
                health = worst(healths)
            except Exception as error:  # an odd object must not keep other rollouts from an answer
                log.debug("a status cannot be read: %r", error)
                health = Health("waiting", "the status on the cluster cannot be read", failing=True)
            # The watches lag behind each other: a Deployment may look healthy only because its
            # change has not come yet. So read all once more.
            if health.reaches("healthy") and not (rollout.confirmed or last):
                self._in_background(rollout, self._confirm)
                continue
            states = [
                (level, level) for level in ("reconciled", "healthy") if health.reaches(level)
            ]
            if health.failing:
                states.append(("failing", f"{health.object}: {health.reason}"))
            for state, text in states:
                if text not in rollout.reported:
                    rollout.reported.add(text)
                    rollout.on_progress(state, text)
            rollout.failed = health if health.failing else rollout.failed
            if health.reaches(rollout.level) or last:
                self._resolve(rollout, health)
            elif self._runtime.monotonic() > rollout.deadline:
                self._in_background(rollout, partial(self._time_out, health=health))

    def _in_background(self, rollout: _Rollout, work: Callable[[_Rollout], None]) -> None:
        # a thread of its own, because it calls a cluster, which may not answer
        rollout.busy = True

        def run() -> None:
            try:
                work(rollout)
            except Exception as error:
                log.debug("a cluster did not answer: %s", error)
            rollout.busy = False
            self._changed.set()

        self._runtime.start_thread("status-ask", run)

    def _confirm(self, rollout: _Rollout) -> None:
        for domain in rollout.domains:
            self._caches[domain.cluster].refresh(health_reader(domain).objects_to_confirm(domain))
        rollout.confirmed = True

    def _time_out(self, rollout: _Rollout, health: Health) -> None:
        # The reason is to be as exact as possible: while a controller retries, its object no longer
        # says why the last attempt failed, and a Deployment never says why its pods do not run.
        if (failed := rollout.failed) and not health.failing and failed.object == health.object:
            health = replace(health, reason=f"{health.reason}; before: {failed.reason}")
        kind, _, name = health.object.partition(" ")
        if kind == "Deployment":
            namespace, _, deployment = name.partition("/")
            with suppress(Exception):
                for domain in rollout.domains:
                    if domain.namespace == namespace:
                        cache = self._caches[domain.cluster]
                        if reason := why_unavailable(cache.pods(namespace, deployment)):
                            health = replace(health, reason=f"{health.reason}; {reason}")
                            break
        self._resolve(rollout, health)

    def _resolve(self, rollout: _Rollout, health: Health) -> None:
        with self._lock:
            if rollout not in self._open:  # a timeout and the end of this watcher may meet here
                return
            self._open.remove(rollout)
        rollout.future.set_result(health)
