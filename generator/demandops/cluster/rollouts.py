"""What the clusters report of releases: the state of each now, and as it changes until it runs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Literal

from demandops.base.errors import Refused
from demandops.base.runtime import REAL, Runtime, log
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.health import (
    ClusterDomain,
    Health,
    History,
    Level,
    ObjectSelector,
    Target,
    health_reader,
    name_of,
    worst,
)
from demandops.cluster.watches import ObjectCache, object_caches
from demandops.decide.decision import Decision
from demandops.decide.planning.overrides import without_suspended
from demandops.decide.planning.planner import affected_keys, keys_of_claims, plan
from demandops.decide.state import State
from demandops.model.config.policy import AccessDomain
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.ledger.claim import ClaimKey, demand_id
from demandops.model.ledger.ledger import World
from demandops.model.release import Release, ServiceRelease
from demandops.render.gitops import (
    bootstrap_path,
    digest_in,
    digest_of,
    domains_by_cluster,
    project_of,
)

# ---- the targets: what a release is on its cluster ----


def targets_of_decision(before: World, decision: Decision) -> tuple[Target, ...]:
    # of the releases that a demand needs, changes or removes; what only other demands need is left
    # out, even if they share a subject with this one
    after, request = decision.state, decision.request
    active = without_suspended(after)
    claims = [*active.ledger.claims_with("demand", request.demand)]
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
    by_cluster, settings = domains_by_cluster(state.config), state.config.repo_settings
    pairs = ((cluster, domain) for cluster, domains in by_cluster.items() for domain in domains)
    return [cluster_domain(cluster, domain, settings) for cluster, domain in pairs]


def cluster_domain(cluster: str, domain: AccessDomain, repository: RepoSettings) -> ClusterDomain:
    application = None  # with Argo CD, the Application that applies the folder of the domain
    if repository.gitops == "argocd" and repository.argocd:
        name = project_of(domain, repository)
        application = ObjectSelector("Application", repository.argocd.namespace, name)
    return ClusterDomain(cluster, domain.name, domain.namespace, application)


def target_of(release: Release, repository: RepoSettings, *, wanted: bool = True) -> Target:
    domain = cluster_domain(release.node.cluster, release.domain, repository)
    return Target(domain, release.name, isinstance(release, ServiceRelease), wanted)


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
    def state(self) -> Literal["waiting", "reconciled", "healthy", "unknown"]:
        # of a cluster that cannot be read, the state is `waiting`, and the reason says so
        return self.health.state if self.seen or self.health.object else "unknown"


# Returns the paths in which two commits differ, if that is known.
ChangedPaths = Callable[[str, str], "Collection[str] | None"]


def statuses(
    targets: Iterable[Target],
    commit: str,
    caches: Mapping[str, ObjectCache],
    history: History,
    changed: ChangedPaths,
) -> list[ReleaseStatus]:
    changed = cache(changed)
    history = _CachedHistory(history)
    objects = {name: store.objects() for name, store in caches.items()}
    unread: dict[ClusterDomain, Health | None] = {}
    results = []
    for target in targets:
        domain = target.domain
        if (store := caches.get(domain.cluster)) is None:
            results.append(ReleaseStatus(Health("waiting")))
            continue
        if domain not in unread:
            unread[domain] = store.unknown_health(domain)
        if reason := unread[domain]:
            since = caches[domain.cluster].unread_since
            results.append(ReleaseStatus(reason, since=since))
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


# ---- following until a release is reconciled or healthy, as requested ----
#
# One thread evaluates the rollouts whenever a watch reports a change. An unreachable cluster delays
# only its own rollouts.

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
        for store in self._caches.values():
            store.close()

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
        objects = {name: store.objects() for name, store in self._caches.items()}
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
                        store = self._caches[domain.cluster]
                        if reason := store.why_unavailable(namespace, deployment):
                            health = replace(health, reason=f"{health.reason}; {reason}")
                            break
        self._resolve(rollout, health)

    def _resolve(self, rollout: _Rollout, health: Health) -> None:
        with self._lock:
            if rollout not in self._open:  # a timeout and the end of this watcher may meet here
                return
            self._open.remove(rollout)
        rollout.future.set_result(health)
