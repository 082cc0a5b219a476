"""Computes the health of releases: the part that is the same for Flux and Argo CD. Pure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

Level = Literal["pushed", "reconciled", "healthy"]
State = Literal["waiting", "reconciled", "healthy"]

_ORDER: dict[str, int] = {"waiting": 0, "pushed": 0, "reconciled": 1, "healthy": 2}


class ObjectName(NamedTuple):
    namespace: str
    name: str


class ObjectSelector(NamedTuple):
    """Selects objects of a kind in a namespace, or only the one of a name."""

    kind: str
    namespace: str
    name: str = ""


@dataclass(frozen=True, slots=True)
class ClusterDomain:
    cluster: str
    name: str
    namespace: str
    application: ObjectName | None = None  # of Argo CD, for the domain's folder; None with Flux


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
    """Queries on the state repo's commits."""

    def includes(self, commit: str, other: str) -> bool:
        """Return whether ``commit`` is ``other`` or a descendant of ``other``."""
        ...

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        """Return whether ``path`` exists in two commits with equal content."""
        ...


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
    def objects_to_watch(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        """Return the objects on which the health of a domain and of its releases depends."""

    def objects_to_confirm(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        """Return the objects to read again before a release counts as healthy."""
        # in this order: a service object that is ready counts with Deployments read after it
        kinds = (self.service_kind, "Deployment")
        return tuple(ObjectSelector(kind, domain.namespace) for kind in kinds)

    @abstractmethod
    def domain_health(
        self, domain: ClusterDomain, commit: str, objects: Objects, history: History
    ) -> Health:
        """Return ``waiting`` until a domain has applied ``commit``, then ``reconciled``."""

    def health(self, target: Target, commit: str, objects: Objects, history: History) -> Health:
        """Return the health of a release: ``waiting`` until its domain has applied ``commit``."""
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
            message = self._why_not_removed(item or {}) if target.is_service else ""
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
        state = self._service_state(status) if target.is_service else condition(status, "Available")
        return str(state.get("lastTransitionTime", ""))

    @abstractmethod
    def _service_health(
        self, target: Target, item: Object, commit: str, objects: Objects, history: History
    ) -> Health:
        """Return the health of a service whose object exists."""

    @abstractmethod
    def _service_state(self, status: Object) -> Object:
        """Return the part of a service object's status that has ``lastTransitionTime``."""

    @abstractmethod
    def _owns(self, target: Target, deployment: Object) -> bool:
        """Return whether a service's release owns a Deployment."""

    def _why_not_removed(self, item: Object) -> str:
        """Return why the controller fails to remove a service; empty if no failure is known."""
        return ""

    def _deployments(self, target: Target, objects: Objects) -> list[Object]:
        return [
            item
            for (kind, namespace, _), item in objects.items()
            if kind == "Deployment"
            and namespace == target.domain.namespace
            and self._owns(target, item)
        ]


def name_of(key: Key) -> str:
    """Return kind, namespace and name of an object as text: ``Deployment perception/od-edge``."""
    kind, namespace, name = key
    return f"{kind} {namespace}/{name}"


def deployment_health(deployment: Object) -> Health:
    """Return ``healthy`` if all replicas are available and run the current spec."""
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


def why_unavailable(pods: Iterable[Any]) -> str:
    """Return why pods do not run, as a container or the scheduler reports; empty if unknown."""
    for pod in pods:
        for container in pod.status.container_statuses or ():
            waiting = container.state.waiting if container.state else None
            if waiting and waiting.reason not in (None, "ContainerCreating"):
                message = f": {waiting.message}" if waiting.message else ""
                return f"container {container.name}: {waiting.reason}{message}"
        for reported in pod.status.conditions or ():
            if reported.type == "PodScheduled" and reported.status == "False":
                return f"not scheduled: {reported.message}"
    return ""


def condition(status: Object, kind: str) -> Object:
    """Return the condition of type ``kind`` in a status; empty if there is none."""
    conditions = status.get("conditions") or ()
    return next((item for item in conditions if item.get("type") == kind), {})
