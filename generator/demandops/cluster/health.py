"""The health of releases, from the objects of Flux or Argo CD. Pure.

Objects are plain data as the Kubernetes API returns them. The reader is chosen for each
:class:`ClusterDomain`, so a state repo may switch from one controller to the other while rollouts
are followed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

from demandops.render.gitops import bootstrap_path

# ---- the part that is the same for Flux and Argo CD ----

Level = Literal["pushed", "reconciled", "healthy"]
State = Literal["waiting", "reconciled", "healthy"]

_ORDER: dict[str, int] = {"waiting": 0, "pushed": 0, "reconciled": 1, "healthy": 2}


class ObjectSelector(NamedTuple):
    kind: str
    namespace: str
    name: str = ""  # all of the namespace, if it is empty


@dataclass(frozen=True, slots=True)
class ClusterDomain:
    cluster: str
    name: str
    namespace: str
    # the Argo CD Application that applies the domain's folder
    application: ObjectSelector | None = None


@dataclass(frozen=True, slots=True)
class Target:
    domain: ClusterDomain
    name: str
    is_service: bool  # else it is the Deployment of a communication client
    wanted: bool = True


@dataclass(frozen=True, slots=True)
class Health:
    state: State
    reason: str = ""  # why the next state is not reached, if possible in the controller's words
    object: str = ""  # from which the reason comes
    failing: bool = False

    def reaches(self, level: Level) -> bool:
        return _ORDER[self.state] >= _ORDER[level]


Key = tuple[str, str, str]  # kind, namespace and name of an object
Object = Mapping[str, Any]
Objects = Mapping[Key, Object]


class History(Protocol):
    def includes(self, commit: str, other: str) -> bool:
        """Return whether ``commit`` is ``other`` or a descendant of ``other``."""

    def unchanged(self, commit: str, other: str, path: str) -> bool: ...


def worst(healths: list[Health]) -> Health:
    """Return the health with the lowest state, and among those a failing one; of none, healthy."""
    return min(
        healths,
        key=lambda health: (_ORDER[health.state], not health.failing),
        default=Health("healthy"),
    )


class HealthReader(ABC):
    service_kind: str  # of the object that represents a service

    @abstractmethod
    def objects_to_watch(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]: ...

    def objects_to_confirm(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        # Read again before a release counts as healthy, in this order: a service object that is
        # ready counts with Deployments that are read after it.
        kinds = (self.service_kind, "Deployment")
        return tuple(ObjectSelector(kind, domain.namespace) for kind in kinds)

    @abstractmethod
    def domain_health(
        self, domain: ClusterDomain, commit: str, objects: Objects, history: History
    ) -> Health:
        """Return ``waiting`` until a domain has applied ``commit``, then ``reconciled``."""

    def health(self, target: Target, commit: str, objects: Objects, history: History) -> Health:
        domain = self.domain_health(target.domain, commit, objects, history)
        if domain.state == "waiting":
            return domain
        return self.release_health(target, commit, objects, history)

    def release_health(
        self, target: Target, commit: str, objects: Objects, history: History
    ) -> Health:
        key = self.key(target)
        item = objects.get(key)
        if not target.wanted:  # then it is healthy if it is gone
            if item is None and not (target.is_service and self._deployments(target, objects)):
                return Health("healthy")
            # Argo CD says in a condition why it fails to remove a service, and Flux does not
            message = _error(item or {}) if target.is_service else ""
            reason = f"is still being removed; {message}" if message else "is still being removed"
            return Health("reconciled", reason, name_of(key), failing=bool(message))
        if item is None:
            return Health("reconciled", "does not exist yet", name_of(key))
        if not target.is_service:
            return deployment_health(item)
        return self._service_health(target, item, commit, objects, history)

    @abstractmethod
    def follower(self, domain: ClusterDomain) -> Key:
        """Return the key of the object, from the bootstrap file, that applies a domain's folder."""

    @abstractmethod
    def applied_commit(self, domain: ClusterDomain, objects: Objects) -> str:
        """Return the commit up to which a domain's folder is applied; empty if it is not known."""

    def key(self, target: Target) -> Key:
        kind = self.service_kind if target.is_service else "Deployment"
        return kind, target.domain.namespace, target.name

    @abstractmethod
    def applied_by(self, domain: ClusterDomain, item: Object) -> bool:
        """Return whether ``item`` was created by a domain's :meth:`follower`."""

    def last_transition(self, target: Target, objects: Objects) -> str:
        """Return when the state of a release last changed; empty if the cluster does not say."""
        status = (objects.get(self.key(target)) or {}).get("status") or {}
        state = condition(status, "Ready" if target.is_service else "Available")
        # an Application has no such condition
        return str((state or status.get("health") or {}).get("lastTransitionTime", ""))

    @abstractmethod
    def _service_health(
        self, target: Target, item: Object, commit: str, objects: Objects, history: History
    ) -> Health: ...

    @abstractmethod
    def _owns(self, target: Target, deployment: Object) -> bool: ...

    def _deployments(self, target: Target, objects: Objects) -> list[Object]:
        return [
            item
            for (kind, namespace, _), item in objects.items()
            if kind == "Deployment"
            and namespace == target.domain.namespace
            and self._owns(target, item)
        ]


def name_of(key: Key) -> str:
    kind, namespace, name = key
    return f"{kind} {namespace}/{name}"


def deployment_health(deployment: Object) -> Health:
    metadata, status = deployment["metadata"], deployment.get("status") or {}
    name = name_of(("Deployment", metadata.get("namespace"), metadata.get("name")))
    replicas = (deployment.get("spec") or {}).get("replicas")
    wanted = 1 if replicas is None else replicas  # the default of Kubernetes
    current = (status.get("observedGeneration") or 0) >= (metadata.get("generation") or 0)
    updated, available = status.get("updatedReplicas") or 0, status.get("availableReplicas") or 0
    if current and updated >= wanted and available >= wanted:
        return Health("healthy")
    for kind, bad in (("ReplicaFailure", "True"), ("Progressing", "False")):
        problem = condition(status, kind)
        if problem.get("status") == bad:
            message = str(problem.get("message", ""))
            return Health("reconciled", message, name, failing=True)
    return Health("reconciled", f"{available} of {wanted} replicas are available", name)


def condition(status: Object, kind: str) -> Object:
    conditions = status.get("conditions") or ()
    return next((item for item in conditions if item.get("type") == kind), {})


# ---- Flux ----
#
# The field names are those of Flux 2.9 (kustomize.toolkit.fluxcd.io/v1,
# helm.toolkit.fluxcd.io/v2).

# The annotation that makes a controller reconcile an object now.
REQUESTED_AT = "reconcile.fluxcd.io/requestedAt"
# The labels that kustomize-controller sets on everything that it applies.
_APPLIED_BY = "kustomize.toolkit.fluxcd.io/name"
_APPLIED_IN = "kustomize.toolkit.fluxcd.io/namespace"
# The label that helm-controller sets on everything that it installs.
_HELM_NAME = "helm.toolkit.fluxcd.io/name"


class Flux(HealthReader):
    service_kind = "HelmRelease"

    def objects_to_watch(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        kinds = ("Kustomization", "GitRepository", "HelmRelease", "Deployment")
        return tuple(ObjectSelector(kind, domain.namespace) for kind in kinds)

    def domain_health(
        self, domain: ClusterDomain, commit: str, objects: Objects, history: History
    ) -> Health:
        kustomization = objects.get(self.follower(domain))
        name = name_of(self.follower(domain))
        if kustomization is None:
            missing = f"does not exist; apply {bootstrap_path(domain.cluster)} to the cluster"
            return Health("waiting", missing, name)
        status = kustomization.get("status") or {}
        reached = _commit(status.get("lastAppliedRevision"))
        if reached and history.includes(reached, commit):
            return Health("reconciled")
        attempted = _commit(status.get("lastAttemptedRevision"))
        ready = condition(status, "Ready")
        if ready.get("status") == "False" and attempted and history.includes(attempted, commit):
            return Health("waiting", str(ready.get("message", "")), name, failing=True)
        source = self._source(domain, objects) or {}
        fetched = condition(source.get("status") or {}, "Ready")
        if fetched.get("status") == "False":
            at = name_of(("GitRepository", domain.namespace, _source_name(kustomization)))
            return Health("waiting", str(fetched.get("message", "")), at, failing=True)
        return Health("waiting", "has not applied the commit yet", name)

    def follower(self, domain: ClusterDomain) -> Key:
        return "Kustomization", domain.namespace, domain.name

    def applied_commit(self, domain: ClusterDomain, objects: Objects) -> str:
        kustomization = objects.get(self.follower(domain)) or {}
        return _commit((kustomization.get("status") or {}).get("lastAppliedRevision"))

    def applied_by(self, domain: ClusterDomain, item: Object) -> bool:
        labels = item["metadata"].get("labels") or {}
        return (labels.get(_APPLIED_IN), labels.get(_APPLIED_BY)) == self.follower(domain)[1:]

    def handled_request(self, domain: ClusterDomain, objects: Objects) -> str:
        status = (self._source(domain, objects) or {}).get("status") or {}
        return str(status.get("lastHandledReconcileAt", ""))

    def is_idle(self, domain: ClusterDomain, objects: Objects, before: str | None) -> bool:
        # whether Flux has finished all work of a domain's last fetch; ``before`` is what
        # `handled_request` returned before the last fetch request was made, if one was
        kustomization, source = objects.get(self.follower(domain)), self._source(domain, objects)
        # what does not exist or is suspended never fetches, and must not hold up the next request
        if kustomization is None or source is None:
            return True
        if any((item.get("spec") or {}).get("suspend") for item in (kustomization, source)):
            return True
        asked = (source["metadata"].get("annotations") or {}).get(REQUESTED_AT, "")
        handled = self.handled_request(domain, objects)
        if handled == before or handled != asked:
            return False
        status = kustomization.get("status") or {}
        fetched = ((source.get("status") or {}).get("artifact") or {}).get("revision")
        ended = condition(status, "Ready").get("status") in ("True", "False")
        return ended and status.get("lastAttemptedRevision") == fetched

    def _source(self, domain: ClusterDomain, objects: Objects) -> Object | None:
        kustomization = objects.get(self.follower(domain)) or {}
        return objects.get(("GitRepository", domain.namespace, _source_name(kustomization)))

    def _service_health(
        self, target: Target, item: Object, commit: str, objects: Objects, history: History
    ) -> Health:
        del commit, history  # domain_health has checked the commit
        name = name_of(self.key(target))
        status = item.get("status") or {}
        ready = condition(status, "Ready")
        # until then, the condition is that of the former spec
        current = status.get("observedGeneration") == item["metadata"].get("generation")
        if ready.get("status") == "False":
            return Health("reconciled", str(ready.get("message", "")), name, failing=True)
        if not current or ready.get("status") != "True":
            return Health("reconciled", str(ready.get("message") or "is being installed"), name)
        return worst([deployment_health(owned) for owned in self._deployments(target, objects)])

    def _owns(self, target: Target, deployment: Object) -> bool:
        return (deployment["metadata"].get("labels") or {}).get(_HELM_NAME) == target.name


def _source_name(kustomization: Object) -> str:
    return str(((kustomization.get("spec") or {}).get("sourceRef") or {}).get("name", ""))


def _commit(revision: object) -> str:
    # Flux writes a revision as main@sha1:…
    return str(revision or "").rpartition(":")[2]


# ---- Argo CD ----
#
# The field names are those of Argo CD 3.2 (argoproj.io/v1alpha1). The status of an Application lags
# behind its spec. So a status counts only if its ``sync.comparedTo`` holds the source of the
# current spec.

_TRACKED_BY = "argocd.argoproj.io/tracking-id"
_DETAILS = 3  # a reason lists at most this many objects on which a sync failed


class ArgoCd(HealthReader):
    service_kind = "Application"

    def objects_to_watch(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        return self.follower(domain), *self.objects_to_confirm(domain)

    def domain_health(
        self, domain: ClusterDomain, commit: str, objects: Objects, history: History
    ) -> Health:
        name = name_of(self.follower(domain))
        if (app := objects.get(self.follower(domain))) is None:
            missing = f"does not exist; apply {bootstrap_path(domain.cluster)} to the cluster"
            return Health("waiting", missing, name)
        if any(history.includes(revision, commit) for revision in _applied_commits(app)):
            return Health("reconciled")
        waiting = "has not applied the commit yet"
        message, revision = _failure(app)
        if not message:
            return Health("waiting", waiting, name)
        # a failure at another commit may be over once Argo CD has tried this one
        if revision and not history.includes(revision, commit):
            reason = f"{waiting}; Argo CD reports for {revision[:10]}: {message}"
            return Health("waiting", reason, name)
        return Health("waiting", message, name, failing=True)

    def follower(self, domain: ClusterDomain) -> ObjectSelector:
        assert domain.application is not None  # noqa: S101 - otherwise Flux's reader is used
        return domain.application

    def applied_commit(self, domain: ClusterDomain, objects: Objects) -> str:
        app = objects.get(self.follower(domain))
        return next(iter(_applied_commits(app)), "") if app else ""

    def applied_by(self, domain: ClusterDomain, item: Object) -> bool:
        return _is_tracked_by(item, self.follower(domain).name)

    def _service_health(
        self, target: Target, item: Object, commit: str, objects: Objects, history: History
    ) -> Health:
        name = name_of(self.key(target))
        if item["metadata"].get("deletionTimestamp"):
            return Health("reconciled", "is being removed and will then be created again", name)
        outdated = _why_outdated(target.domain, item, commit, objects, history)
        if not outdated and _status(item, "sync").get("status") == "Synced":
            for resource in (item.get("status") or {}).get("resources") or ():
                if resource.get("kind") != "Deployment":
                    continue
                namespace, deployment = resource.get("namespace", ""), resource.get("name", "")
                key = ("Deployment", str(namespace), str(deployment))
                if key not in objects:
                    return Health("reconciled", "does not exist yet", name_of(key))
                health = deployment_health(objects[key])
                if health.state != "healthy":
                    return health
            reported = _status(item, "health")
            level = reported.get("status")
            if level == "Healthy":
                return Health("healthy")
            reason = str(reported.get("message") or f"its health is {level or 'not known yet'}")
            return Health("reconciled", reason, name, failing=level == "Degraded")
        message, _ = _failure(item)
        if message:
            return Health("reconciled", message, name, failing=True)
        running = str(_status(item, "operationState").get("message") or "is being synced")
        return Health("reconciled", outdated or running, name)

    def _owns(self, target: Target, deployment: Object) -> bool:
        return _is_tracked_by(deployment, f"{target.domain.namespace}_{target.name}")


def _is_tracked_by(item: Object, application: str) -> bool:
    annotations = item["metadata"].get("annotations") or {}
    return str(annotations.get(_TRACKED_BY, "")).startswith(f"{application}:")


def _applied_commits(app: Object) -> list[str]:
    """Return the commits that an Application is known to have applied, the newest first."""
    source = (app.get("spec") or {}).get("source")
    sync, operation = _status(app, "sync"), _status(app, "operationState")
    revisions = []
    # a Synced Application has applied the commit that it was compared with
    compared = (sync.get("comparedTo") or {}).get("source")
    if sync.get("status") == "Synced" and _same(compared, source):
        revisions.append(str(sync.get("revision", "")))
    # If commits come fast, an Application may never be Synced, so the commit of its last successful
    # sync counts too, unless that was only for some resources.
    result = operation.get("syncResult") or {}
    is_partial = bool(_requested_sync(operation).get("resources"))
    succeeded = operation.get("phase") == "Succeeded" and not is_partial
    if succeeded and _same(result.get("source"), source):
        revisions.append(str(result.get("revision", "")))
    return [revision for revision in revisions if revision]


def _why_outdated(
    domain: ClusterDomain, app: Object, commit: str, objects: Objects, history: History
) -> str:
    sync, source = _status(app, "sync"), (app.get("spec") or {}).get("source") or {}
    if not sync:
        return "has not been compared yet"
    if not _same((sync.get("comparedTo") or {}).get("source"), source):
        return "has not been compared with its current spec yet"
    application = objects.get(ArgoCd().follower(domain)) or {}
    folder = (application.get("spec") or {}).get("source") or {}
    if source.get("repoURL") != folder.get("repoURL"):
        return ""  # the chart is in a registry, and its version is part of the compared source
    revision = str(sync.get("revision", ""))
    path = str(source.get("path", ""))
    if history.includes(revision, commit) or history.unchanged(revision, commit, path):
        return ""
    return "has not applied the commit's chart yet"


def _failure(app: Object) -> tuple[str, str]:
    """Return why an Application fails, or an empty text, and for which commit, if it is known."""
    operation = _status(app, "operationState")
    result = operation.get("syncResult") or {}
    revision = str(result.get("revision") or _requested_sync(operation).get("revision") or "")
    synced = result.get("source")
    stale = synced and not _same(synced, (app.get("spec") or {}).get("source"))
    phase = operation.get("phase")
    # A failed sync that will be retried has the phase Running and ``finishedAt``.
    if phase == "Running" and operation.get("finishedAt"):
        prefix = "its previous spec is still being retried: " if stale else ""
        return prefix + _sync_message(operation), revision
    if phase in ("Failed", "Error") and not stale:
        return _sync_message(operation), revision
    return _error(app), ""


def _sync_message(operation: Object) -> str:
    message = str(operation.get("message", ""))
    details = [
        f"{item.get('kind')} {item.get('name')}: {item['message']}"
        for item in (operation.get("syncResult") or {}).get("resources") or ()
        if item.get("status") in ("SyncFailed", "PruneSkipped")
        and item.get("message")
        and str(item["message"]) not in message
    ]
    return "; ".join([message, *details[:_DETAILS]])


def _error(app: Object) -> str:
    for item in (app.get("status") or {}).get("conditions") or ():  # the others are warnings
        if str(item.get("type", "")).endswith("Error"):
            return f"{item['type']}: {item.get('message', '')}"
    return ""


def _status(app: Object, part: str) -> Object:
    return (app.get("status") or {}).get(part) or {}


def _requested_sync(operation: Object) -> Object:
    return (operation.get("operation") or {}).get("sync") or {}


def _same(source: object, other: object) -> bool:
    try:  # Argo CD may omit an empty field or write it
        return _without_empty(source) == _without_empty(other)
    except RecursionError:  # nothing that the generator renders is nested so deeply
        return False


def _without_empty(value: object) -> object:
    if isinstance(value, dict):
        items = {key: _without_empty(item) for key, item in value.items()}
        return {key: item for key, item in items.items() if item not in (None, "", {}, [])}
    if isinstance(value, list):
        return [_without_empty(item) for item in value]
    return value


def health_reader(domain: ClusterDomain) -> HealthReader:
    return ArgoCd() if domain.application else Flux()
