"""The health of releases for any GitOps controller; each controller adds its part. Pure."""

from __future__ import annotations

from abc import ABC, abstractmethod

from demandops.cluster.health.deployment import condition, deployment_health
from demandops.cluster.health.model import (
    ClusterDomain,
    Health,
    History,
    Key,
    Object,
    Objects,
    ObjectSelector,
    Target,
)


class HealthReader(ABC):
    """Reads the health of releases from the objects of a GitOps controller."""

    service_kind: str
    """The kind of the object that represents a service."""

    @abstractmethod
    def objects_to_watch(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        """Return the objects that the health of a domain and its releases depends on."""

    def objects_to_confirm(self, domain: ClusterDomain) -> tuple[ObjectSelector, ...]:
        """Return the objects to read again before a release counts as healthy: owners first."""
        kinds = (self.service_kind, "Deployment")
        return tuple(ObjectSelector(kind, domain.namespace) for kind in kinds)

    @abstractmethod
    def domain_health(
        self, domain: ClusterDomain, commit: str, objects: Objects, history: History
    ) -> Health:
        """Return how far a domain has applied a commit."""

    def release_health(
        self, target: Target, commit: str, objects: Objects, history: History
    ) -> Health:
        """Return how far an applied commit has started a release, or removed it if unwanted."""
        key = self._key(target)
        item = objects.get(key)
        if not target.wanted:
            return self._removal_health(target, item, objects)
        if item is None:
            return Health("reconciled", "does not exist yet", name_of(key))
        if not target.by_helm:
            return deployment_health(item)
        return self._service_health(target, item, commit, objects, history)

    @abstractmethod
    def applied_commit(self, domain: ClusterDomain, objects: Objects) -> str:
        """Return the commit that a domain has applied; empty if it is not known."""

    def last_transition(self, target: Target, objects: Objects) -> str:
        """Return when the state of a release last changed; empty if the cluster does not say."""
        status = (objects.get(self._key(target)) or {}).get("status") or {}
        state = self._service_state(status) if target.by_helm else condition(status, "Available")
        return str(state.get("lastTransitionTime", ""))

    @abstractmethod
    def _service_health(
        self, target: Target, item: Object, commit: str, objects: Objects, history: History
    ) -> Health:
        """Return how far a service with an existing object has started."""

    @abstractmethod
    def _service_state(self, status: Object) -> Object:
        """Return the part of a service's status that has the time of the last change."""

    @abstractmethod
    def _made(self, target: Target, deployment: Object) -> bool:
        """Return whether the controller made a Deployment for a service."""

    def _why_not_removed(self, item: Object) -> str:
        """Return why the controller fails to remove a service; empty if it does not fail."""
        return ""

    def _key(self, target: Target) -> Key:
        kind = self.service_kind if target.by_helm else "Deployment"
        return kind, target.domain.namespace, target.name

    def _deployments(self, target: Target, objects: Objects) -> list[Object]:
        """Return the Deployments of a service."""
        return [
            item
            for (kind, namespace, _), item in objects.items()
            if kind == "Deployment"
            and namespace == target.domain.namespace
            and self._made(target, item)
        ]

    def _removal_health(self, target: Target, item: Object | None, objects: Objects) -> Health:
        if item is None and not (target.by_helm and self._deployments(target, objects)):
            return Health("healthy")
        message = self._why_not_removed(item or {}) if target.by_helm else ""
        reason = f"is still being removed; {message}" if message else "is still being removed"
        return Health("reconciled", reason, name_of(self._key(target)), failing=bool(message))


def name_of(key: Key) -> str:
    """Return the name of an object for people: ``Deployment perception/od-edge``."""
    kind, namespace, name = key
    return f"{kind} {namespace}/{name}"
