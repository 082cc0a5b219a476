"""The health of releases, from Argo CD's objects. Pure.

Objects are plain data as the Kubernetes API returns them. The field names are those of Argo CD 3.2
(argoproj.io/v1alpha1). The status of an Application lags behind its spec. So a status counts only
if its ``sync.comparedTo`` holds the source of the current spec.
"""

from __future__ import annotations

from demandops.cluster.health.release_health import (
    ClusterDomain,
    Health,
    HealthReader,
    History,
    Key,
    Object,
    ObjectName,
    Objects,
    ObjectSelector,
    Target,
    deployment_health,
    name_of,
)
from demandops.render.paths import bootstrap_path

_TRACKED_BY = "argocd.argoproj.io/tracking-id"
# A reason lists at most this many objects on which a sync failed.
_DETAILS = 3


class ArgoCd(HealthReader):
    service_kind = "Application"

    def objects_to_watch(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        folder = ObjectSelector("Application", *_folder_application(domain))
        return folder, *self.objects_to_confirm(domain)

    def domain_health(
        self, domain: ClusterDomain, commit: str, objects: Objects, history: History
    ) -> Health:
        name = name_of(self.follower(domain))
        app = objects.get(self.follower(domain))
        if app is None:
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

    def follower(self, domain: ClusterDomain) -> Key:
        return "Application", *_folder_application(domain)

    def applied_commit(self, domain: ClusterDomain, objects: Objects) -> str:
        app = objects.get(self.follower(domain))
        return next(iter(_applied_commits(app)), "") if app else ""

    def applied_by(self, domain: ClusterDomain, item: Object) -> bool:
        annotations = item["metadata"].get("annotations") or {}
        tracked = f"{_folder_application(domain).name}:"
        return str(annotations.get(_TRACKED_BY, "")).startswith(tracked)

    def _service_health(
        self, target: Target, item: Object, commit: str, objects: Objects, history: History
    ) -> Health:
        name = name_of(self.key(target))
        if item["metadata"].get("deletionTimestamp"):
            return Health("reconciled", "is being removed and will then be created again", name)
        outdated = _why_outdated(target.domain, item, commit, objects, history)
        if not outdated and _status(item, "sync").get("status") == "Synced":
            return _synced_health(item, name, objects)
        message, _ = _failure(item)
        if message:
            return Health("reconciled", message, name, failing=True)
        running = str(_status(item, "operationState").get("message") or "is being synced")
        return Health("reconciled", outdated or running, name)

    def _service_state(self, status: Object) -> Object:
        return status.get("health") or {}

    def _owns(self, target: Target, deployment: Object) -> bool:
        annotations = deployment["metadata"].get("annotations") or {}
        tracked = f"{target.domain.namespace}_{target.name}:"
        return str(annotations.get(_TRACKED_BY, "")).startswith(tracked)

    def _why_not_removed(self, item: Object) -> str:
        return _error(item)


def _folder_application(domain: ClusterDomain) -> ObjectName:
    assert domain.application is not None  # noqa: S101 - otherwise Flux's reader is used
    return domain.application


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
    whole = operation.get("phase") == "Succeeded" and not _requested_sync(operation).get(
        "resources"
    )
    if whole and _same(result.get("source"), source):
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
    application = objects.get(("Application", *_folder_application(domain))) or {}
    folder = (application.get("spec") or {}).get("source") or {}
    if source.get("repoURL") != folder.get("repoURL"):
        return ""  # the chart is in a registry, and its version is part of the compared source
    revision = str(sync.get("revision", ""))
    path = str(source.get("path", ""))
    if history.includes(revision, commit) or history.unchanged(revision, commit, path):
        return ""
    return "has not applied the commit's chart yet"


def _synced_health(app: Object, name: str, objects: Objects) -> Health:
    for item in (app.get("status") or {}).get("resources") or ():
        if item.get("kind") != "Deployment":
            continue
        key = ("Deployment", str(item.get("namespace", "")), str(item.get("name", "")))
        if key not in objects:
            return Health("reconciled", "does not exist yet", name_of(key))
        health = deployment_health(objects[key])
        if health.state != "healthy":
            return health
    reported = _status(app, "health")
    if reported.get("status") == "Healthy":
        return Health("healthy")
    level = reported.get("status")
    reason = str(reported.get("message") or f"its health is {level or 'not known yet'}")
    return Health("reconciled", reason, name, failing=level == "Degraded")


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
    """Return the message of a failed sync, with those of failed objects that it lacks."""
    message = str(operation.get("message", ""))
    failed = [
        item
        for item in (operation.get("syncResult") or {}).get("resources") or ()
        if item.get("status") in ("SyncFailed", "PruneSkipped") and item.get("message")
    ]
    details = [
        f"{item.get('kind')} {item.get('name')}: {item['message']}"
        for item in failed
        if str(item["message"]) not in message
    ]
    return "; ".join([message, *details[:_DETAILS]])


def _error(app: Object) -> str:
    """Return the first error among the conditions of an Application, or an empty text."""
    for item in (app.get("status") or {}).get("conditions") or ():  # the others are warnings
        if str(item.get("type", "")).endswith("Error"):
            return f"{item['type']}: {item.get('message', '')}"
    return ""


def _status(app: Object, part: str) -> Object:
    return (app.get("status") or {}).get(part) or {}


def _requested_sync(operation: Object) -> Object:
    return (operation.get("operation") or {}).get("sync") or {}


def _same(source: object, other: object) -> bool:
    """Return whether two sources are equal apart from empty fields."""
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
