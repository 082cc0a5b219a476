"""What Argo CD's objects say about releases. Pure: objects in, health out.

Objects are plain data as the Kubernetes API gives them. Field names as of Argo CD 3.2
(argoproj.io/v1alpha1). Status lags behind spec, so nothing is believed that was found of another
form: ``status.sync.comparedTo`` says of which.
"""

from __future__ import annotations

from demandops.cluster.health.deployment import client_health, condition, deployment_health
from demandops.cluster.health.model import (
    ClusterDomain,
    Health,
    History,
    Object,
    ObjectName,
    Objects,
    ObjectSelector,
    Target,
)

_TRACKED_BY = "argocd.argoproj.io/tracking-id"
_DETAILS = 3
"""Of a sync that failed, so many objects are told one by one."""


def objects_to_watch(domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
    """Return what must be known to tell how things are at a domain."""
    return ObjectSelector("Application", *_over(domain)), *objects_to_confirm(domain)


def objects_to_confirm(domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
    """Return what is read once more before something is healthy: releases, then what they own."""
    return ObjectSelector("Application", domain.namespace), ObjectSelector(
        "Deployment", domain.namespace
    )


def domain_health(domain: ClusterDomain, commit: str, objects: Objects, history: History) -> Health:
    """Return whether the Application over an access domain's folder has applied a commit."""
    over = _over(domain)
    name = f"Application {over.namespace}/{over.name}"
    found = objects.get(("Application", *over))
    if found is None:
        return Health("waiting", "is not there; apply bootstrap/ to the cluster", name)
    if any(history.includes(revision, commit) for revision in _applied(found)):
        return Health("reconciled")
    waiting = "has not applied the commit yet"
    message, revision = _trouble(found)
    if not message:
        return Health("waiting", waiting, name)
    if revision and not history.includes(revision, commit):
        return Health("waiting", f"{waiting}; of {revision[:10]} it says: {message}", name)
    return Health("waiting", message, name, failing=True)


def release_health(target: Target, commit: str, objects: Objects, history: History) -> Health:
    """Return whether a release of an applied commit runs, or is gone where it is to be gone."""
    if not target.wanted:
        return _gone(target, objects)
    if not target.by_helm:
        return client_health(target, objects)
    name = f"Application {target.domain.namespace}/{target.name}"
    found = objects.get(("Application", target.domain.namespace, target.name))
    if found is None:
        return Health("reconciled", "is not there yet", name)
    if found["metadata"].get("deletionTimestamp"):
        return Health("reconciled", "is still being removed, and made anew then", name)
    behind = _behind(target.domain, found, commit, objects, history)
    if not behind and _status(found, "sync").get("status") == "Synced":
        return _of_synced(found, name, objects)
    message, _ = _trouble(found)
    if message:
        return Health("reconciled", message, name, failing=True)
    running = str(_status(found, "operationState").get("message") or "is being synced")
    return Health("reconciled", behind or running, name)


def last_transition(target: Target, objects: Objects) -> str:
    """Return since when a release is as it is, as the cluster says it; empty where it does not."""
    kind = "Application" if target.by_helm else "Deployment"
    found = objects.get((kind, target.domain.namespace, target.name)) or {}
    said = condition(found.get("status") or {}, "Available")
    if target.by_helm:
        said = _status(found, "health")
    return str(said.get("lastTransitionTime", ""))


def applied_commit(domain: ClusterDomain, objects: Objects) -> str:
    """Return the commit that an access domain's folder was last seen to be applied from."""
    found = objects.get(("Application", *_over(domain)))
    return next(iter(_applied(found)), "") if found else ""


def _over(domain: ClusterDomain) -> ObjectName:
    assert domain.application is not None  # noqa: S101 - or Flux's reading would be asked
    return domain.application


def _applied(found: Object) -> list[str]:
    """Return the commits that an Application is known to have applied, the newest first.

    The commit that it was compared with counts where it was found Synced. Where commits come fast
    that may never be seen; then the last sync counts that succeeded and was of everything.
    """
    source = (found.get("spec") or {}).get("source")
    sync, operation = _status(found, "sync"), _status(found, "operationState")
    revisions = []
    compared = (sync.get("comparedTo") or {}).get("source")
    if sync.get("status") == "Synced" and _same(compared, source):
        revisions.append(str(sync.get("revision", "")))
    result = operation.get("syncResult") or {}
    partial = _asked(operation).get("resources")
    if (
        operation.get("phase") == "Succeeded"
        and not partial
        and _same(result.get("source"), source)
    ):
        revisions.append(str(result.get("revision", "")))
    return [revision for revision in revisions if revision]


def _behind(
    domain: ClusterDomain, found: Object, commit: str, objects: Objects, history: History
) -> str:
    """Return why the status of a service's Application is not about what is wanted of it."""
    sync, source = _status(found, "sync"), (found.get("spec") or {}).get("source") or {}
    if not sync:
        return "was not looked at yet"
    if not _same((sync.get("comparedTo") or {}).get("source"), source):
        return "was not compared in its present form yet"
    over = objects.get(("Application", *_over(domain))) or {}
    folder = (over.get("spec") or {}).get("source") or {}
    if source.get("repoURL") != folder.get("repoURL"):
        return ""  # the chart is in a registry, and its version part of the source
    revision = str(sync.get("revision", ""))
    if history.includes(revision, commit):
        return ""
    if history.unchanged(revision, commit, str(source.get("path", ""))):
        return ""
    return "has not taken the commit's chart yet"


def _of_synced(found: Object, name: str, objects: Objects) -> Health:
    """Return the health of a service that is applied as wanted, by what it is made of."""
    for item in (found.get("status") or {}).get("resources") or ():
        if item.get("kind") != "Deployment":
            continue
        key = ("Deployment", str(item.get("namespace", "")), str(item.get("name", "")))
        if key not in objects:
            return Health("reconciled", "is not there yet", f"Deployment {key[1]}/{key[2]}")
        health = deployment_health(objects[key])
        if health.state != "healthy":
            return health
    said = _status(found, "health")
    if said.get("status") == "Healthy":
        return Health("healthy")
    reason = str(said.get("message") or f"its health is {said.get('status') or 'not known yet'}")
    return Health("reconciled", reason, name, failing=said.get("status") == "Degraded")


def _gone(target: Target, objects: Objects) -> Health:
    namespace = target.domain.namespace
    kind = "Application" if target.by_helm else "Deployment"
    name = f"{kind} {namespace}/{target.name}"
    found = objects.get((kind, namespace, target.name))
    if found is None and not (target.by_helm and _left(target, objects)):
        return Health("healthy")
    message = _error(found or {}) if target.by_helm else ""
    if message:
        return Health("reconciled", f"is still being removed; {message}", name, failing=True)
    return Health("reconciled", "is still being removed", name)


def _left(target: Target, objects: Objects) -> bool:
    """Tell whether something that an Application made is there without it."""
    tracked = f"{target.domain.namespace}_{target.name}:"
    return any(
        str((found["metadata"].get("annotations") or {}).get(_TRACKED_BY, "")).startswith(tracked)
        for (kind, namespace, _), found in objects.items()
        if kind == "Deployment" and namespace == target.domain.namespace
    )


def _trouble(found: Object) -> tuple[str, str]:
    """Return what Argo CD says against an Application, and of which commit where it says so."""
    operation = _status(found, "operationState")
    result = operation.get("syncResult") or {}
    revision = str(result.get("revision") or _asked(operation).get("revision") or "")
    tried = result.get("source")
    stale = tried and not _same(tried, (found.get("spec") or {}).get("source"))
    phase = operation.get("phase")
    # While it is to be tried again, a sync that failed is called Running, and yet has an end.
    if phase == "Running" and operation.get("finishedAt"):
        return ("its former form is still tried: " if stale else "") + _told(operation), revision
    if phase in ("Failed", "Error") and not stale:
        return _told(operation), revision
    return _error(found), ""


def _told(operation: Object) -> str:
    """Return the message of a sync that failed, and of the objects that it does not speak of."""
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


def _error(found: Object) -> str:
    """Return the first condition that is an error; the others warn."""
    for item in (found.get("status") or {}).get("conditions") or ():
        if str(item.get("type", "")).endswith("Error"):
            return f"{item['type']}: {item.get('message', '')}"
    return ""


def _status(found: Object, part: str) -> Object:
    return (found.get("status") or {}).get(part) or {}


def _asked(operation: Object) -> Object:
    """Return what a sync was asked to do."""
    return (operation.get("operation") or {}).get("sync") or {}


def _same(one: object, other: object) -> bool:
    """Tell whether two sources are the same, whatever Argo CD leaves out or writes out empty."""
    return _bare(one) == _bare(other)


def _bare(value: object) -> object:
    if isinstance(value, dict):
        found = {key: _bare(item) for key, item in value.items()}
        return {key: item for key, item in found.items() if item not in (None, "", {}, [])}
    if isinstance(value, list):
        return [_bare(item) for item in value]
    return value
