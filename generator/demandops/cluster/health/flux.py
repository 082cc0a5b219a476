"""The health of releases, from Flux's objects. Pure.

Objects are plain data as the Kubernetes API returns them. Field names as of Flux 2.9
(kustomize.toolkit.fluxcd.io/v1, helm.toolkit.fluxcd.io/v2).
"""

from __future__ import annotations

from demandops.cluster.health.deployment import client_health, condition, deployment_health
from demandops.cluster.health.model import (
    ClusterDomain,
    Health,
    History,
    Object,
    Objects,
    ObjectSelector,
    Target,
)

_HELM_NAME = "helm.toolkit.fluxcd.io/name"


def objects_to_watch(domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
    """Return the objects that the health of a domain and its releases depends on."""
    kinds = ("Kustomization", "GitRepository", "HelmRelease", "Deployment")
    return tuple(ObjectSelector(kind, domain.namespace) for kind in kinds)


def objects_to_confirm(domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
    """Return the objects to read again before a release counts as healthy: owners come first."""
    return ObjectSelector("HelmRelease", domain.namespace), ObjectSelector(
        "Deployment", domain.namespace
    )


def domain_health(domain: ClusterDomain, commit: str, objects: Objects, history: History) -> Health:
    """Return how far a domain's Kustomization has applied a commit."""
    kustomization = objects.get(("Kustomization", domain.namespace, domain.name))
    name = f"Kustomization {domain.namespace}/{domain.name}"
    if kustomization is None:
        return Health("waiting", "does not exist; apply bootstrap/ to the cluster", name)
    status = kustomization.get("status") or {}
    reached = _commit(status.get("lastAppliedRevision"))
    if reached and history.includes(reached, commit):
        return Health("reconciled")
    attempted = _commit(status.get("lastAttemptedRevision"))
    ready = condition(status, "Ready")
    if ready.get("status") == "False" and attempted and history.includes(attempted, commit):
        return Health("waiting", str(ready.get("message", "")), name, failing=True)
    source = objects.get(("GitRepository", domain.namespace, _source(kustomization)))
    fetched = condition((source or {}).get("status") or {}, "Ready")
    if fetched.get("status") == "False":
        at = f"GitRepository {domain.namespace}/{_source(kustomization)}"
        return Health("waiting", str(fetched.get("message", "")), at, failing=True)
    return Health("waiting", "has not applied the commit yet", name)


def release_health(target: Target, commit: str, objects: Objects, history: History) -> Health:
    """Return how far an applied commit has started a release, or removed it if unwanted."""
    if not target.wanted:
        return _removal_health(target, objects)
    if not target.by_helm:
        return client_health(target, objects)
    release = objects.get(("HelmRelease", target.domain.namespace, target.name))
    name = f"HelmRelease {target.domain.namespace}/{target.name}"
    if release is None:
        return Health("reconciled", "does not exist yet", name)
    status = release.get("status") or {}
    ready = condition(status, "Ready")
    current = status.get("observedGeneration") == release["metadata"].get("generation")
    if ready.get("status") == "False":
        return Health("reconciled", str(ready.get("message", "")), name, failing=True)
    if not current or ready.get("status") != "True":
        return Health("reconciled", str(ready.get("message") or "is being installed"), name)
    for deployment in _deployments(target, objects):
        health = deployment_health(deployment)
        if health.state != "healthy":
            return health
    return Health("healthy")


def last_transition(target: Target, objects: Objects) -> str:
    """Return when the state of a release last changed; empty if the cluster does not say."""
    kind, ready = ("HelmRelease", "Ready") if target.by_helm else ("Deployment", "Available")
    item = objects.get((kind, target.domain.namespace, target.name)) or {}
    return str(condition(item.get("status") or {}, ready).get("lastTransitionTime", ""))


def applied_commit(domain: ClusterDomain, objects: Objects) -> str:
    """Return the commit that a domain's Kustomization has applied; empty if it is not known."""
    kustomization = objects.get(("Kustomization", domain.namespace, domain.name)) or {}
    return _commit((kustomization.get("status") or {}).get("lastAppliedRevision"))


def _removal_health(target: Target, objects: Objects) -> Health:
    namespace = target.domain.namespace
    kind = "HelmRelease" if target.by_helm else "Deployment"
    if (kind, namespace, target.name) in objects or _deployments(target, objects):
        return Health("reconciled", "is still being removed", f"{kind} {namespace}/{target.name}")
    return Health("healthy")


def _deployments(target: Target, objects: Objects) -> list[Object]:
    """Return a release's Deployments; helm-controller labels everything that it installs."""
    if not target.by_helm:
        return []
    return [
        item
        for (kind, namespace, _), item in objects.items()
        if kind == "Deployment"
        and namespace == target.domain.namespace
        and (item["metadata"].get("labels") or {}).get(_HELM_NAME) == target.name
    ]


def _source(kustomization: Object) -> str:
    return str(((kustomization.get("spec") or {}).get("sourceRef") or {}).get("name", ""))


def _commit(revision: object) -> str:
    """Return the commit of a Flux revision (``main@sha1:…``)."""
    return str(revision or "").rpartition(":")[2]
