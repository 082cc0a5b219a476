"""What the objects of a cluster say about releases. Pure: objects in, health out.

Objects are plain data as the Kubernetes API gives them. Field names as of Flux 2.9
(kustomize.toolkit.fluxcd.io/v1, helm.toolkit.fluxcd.io/v2) and apps/v1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

Level = Literal["pushed", "reconciled", "healthy"]
State = Literal["waiting", "reconciled", "healthy"]

_ORDER: dict[str, int] = {"waiting": 0, "pushed": 0, "reconciled": 1, "healthy": 2}
_HELM_NAME = "helm.toolkit.fluxcd.io/name"


@dataclass(frozen=True, slots=True)
class Place:
    """An access domain on a cluster: what one Kustomization applies."""

    cluster: str
    domain: str
    namespace: str


@dataclass(frozen=True, slots=True)
class Target:
    """One release and whether it is to be there. ``by_helm``: a HelmRelease, else a Deployment."""

    place: Place
    name: str
    by_helm: bool
    wanted: bool = True


@dataclass(frozen=True, slots=True)
class Health:
    """How far something is. ``reason`` says why not further, in the controller's words where it

    has some; ``object`` names the object that says so, ``failing`` whether it speaks of a failure.
    """

    state: State
    reason: str = ""
    object: str = ""
    failing: bool = False

    def reaches(self, level: Level) -> bool:
        """Tell whether it is as far as ``level``."""
        return _ORDER[self.state] >= _ORDER[level]


Key = tuple[str, str, str]
"""Kind, namespace, name."""
Objects = Mapping[Key, Mapping[str, Any]]
Includes = Callable[[str, str], bool]
"""Whether the first commit is the second or comes after it."""


def of_place(place: Place, commit: str, objects: Objects, includes: Includes) -> Health:
    """Return whether an access domain's Kustomization has applied a commit."""
    found = objects.get(("Kustomization", place.namespace, place.domain))
    name = f"Kustomization {place.namespace}/{place.domain}"
    if found is None:
        return Health("waiting", "is not there; apply bootstrap/ to the cluster", name)
    status = found.get("status") or {}
    applied = _commit(status.get("lastAppliedRevision"))
    if applied and includes(applied, commit):
        return Health("reconciled")
    attempted = _commit(status.get("lastAttemptedRevision"))
    ready = _condition(status, "Ready")
    if ready.get("status") == "False" and attempted and includes(attempted, commit):
        return Health("waiting", str(ready.get("message", "")), name, failing=True)
    source = objects.get(("GitRepository", place.namespace, _source(found)))
    fetched = _condition((source or {}).get("status") or {}, "Ready")
    if fetched.get("status") == "False":
        at = f"GitRepository {place.namespace}/{_source(found)}"
        return Health("waiting", str(fetched.get("message", "")), at, failing=True)
    return Health("waiting", "has not applied the commit yet", name)


def of_target(target: Target, objects: Objects) -> Health:
    """Return whether a release of an applied commit runs, or is gone where it is to be gone."""
    if not target.wanted:
        return _gone(target, objects)
    namespace = target.place.namespace
    if not target.by_helm:
        found = objects.get(("Deployment", namespace, target.name))
        if found is None:
            return Health("reconciled", "is not there yet", f"Deployment {namespace}/{target.name}")
        return _of_deployment(found)
    release = objects.get(("HelmRelease", namespace, target.name))
    name = f"HelmRelease {namespace}/{target.name}"
    if release is None:
        return Health("reconciled", "is not there yet", name)
    status = release.get("status") or {}
    ready = _condition(status, "Ready")
    current = status.get("observedGeneration") == release["metadata"].get("generation")
    if ready.get("status") == "False":
        return Health("reconciled", str(ready.get("message", "")), name, failing=True)
    if not current or ready.get("status") != "True":
        return Health("reconciled", str(ready.get("message") or "is being installed"), name)
    for deployment in _deployments(target, objects):
        health = _of_deployment(deployment)
        if health.state != "healthy":
            return health
    return Health("healthy")


def since(target: Target, objects: Objects) -> str:
    """Return since when a release is as it is, as the cluster says it; empty where it does not."""
    kind, condition = ("HelmRelease", "Ready") if target.by_helm else ("Deployment", "Available")
    found = objects.get((kind, target.place.namespace, target.name)) or {}
    return str(_condition(found.get("status") or {}, condition).get("lastTransitionTime", ""))


def applied(place: Place, objects: Objects) -> str:
    """Return the commit that an access domain's Kustomization has applied, or nothing."""
    found = objects.get(("Kustomization", place.namespace, place.domain)) or {}
    return _commit((found.get("status") or {}).get("lastAppliedRevision"))


def worst(healths: list[Health]) -> Health:
    """Return the health of the whole: the least far, one that fails before one that waits."""
    return min(
        healths,
        key=lambda health: (_ORDER[health.state], not health.failing),
        default=Health("healthy"),
    )


def _gone(target: Target, objects: Objects) -> Health:
    namespace = target.place.namespace
    kind = "HelmRelease" if target.by_helm else "Deployment"
    if (kind, namespace, target.name) in objects or _deployments(target, objects):
        return Health("reconciled", "is still being removed", f"{kind} {namespace}/{target.name}")
    return Health("healthy")


def _deployments(target: Target, objects: Objects) -> list[Mapping[str, Any]]:
    """Return a release's Deployments; helm-controller labels all that it installs."""
    if not target.by_helm:
        return []
    return [
        found
        for (kind, namespace, _), found in objects.items()
        if kind == "Deployment"
        and namespace == target.place.namespace
        and (found["metadata"].get("labels") or {}).get(_HELM_NAME) == target.name
    ]


def _of_deployment(found: Mapping[str, Any]) -> Health:
    metadata, status = found["metadata"], found.get("status") or {}
    name = f"Deployment {metadata.get('namespace')}/{metadata.get('name')}"
    wanted = (found.get("spec") or {}).get("replicas", 1)
    current = status.get("observedGeneration", 0) >= metadata.get("generation", 0)
    updated, available = status.get("updatedReplicas", 0), status.get("availableReplicas", 0)
    if current and updated >= wanted and available >= wanted:
        return Health("healthy")
    for kind, bad in (("ReplicaFailure", "True"), ("Progressing", "False")):
        condition = _condition(status, kind)
        if condition.get("status") == bad:
            return Health("reconciled", str(condition.get("message", "")), name, failing=True)
    reason = f"{available} of {wanted} replicas are available"
    return Health("reconciled", reason, name)


def _condition(status: Mapping[str, Any], kind: str) -> Mapping[str, Any]:
    found = (item for item in status.get("conditions") or () if item.get("type") == kind)
    return next(found, {})


def _source(kustomization: Mapping[str, Any]) -> str:
    return str(((kustomization.get("spec") or {}).get("sourceRef") or {}).get("name", ""))


def _commit(revision: object) -> str:
    """Return the commit of a Flux revision (``main@sha1:…``)."""
    return str(revision or "").rpartition(":")[2]
