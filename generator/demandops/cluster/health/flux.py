"""The health of releases, from Flux's objects. Pure.

Objects are plain data as the Kubernetes API returns them. The field names are
those of Flux 2.9 (kustomize.toolkit.fluxcd.io/v1, helm.toolkit.fluxcd.io/v2).
"""

from __future__ import annotations

from demandops.cluster.health.release_health import (
    ClusterDomain,
    Health,
    HealthReader,
    History,
    Key,
    Object,
    Objects,
    ObjectSelector,
    Target,
    condition,
    deployment_health,
    name_of,
    worst,
)
from demandops.render.paths import bootstrap_path

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
            at = f"GitRepository {domain.namespace}/{_source_name(kustomization)}"
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
        """Return the time stamp of the last fetch request that the source handled, or empty."""
        return _handled(self._source(domain, objects) or {})

    def is_idle(self, domain: ClusterDomain, objects: Objects, before: str | None) -> bool:
        """Return whether Flux has finished all work of a domain's last fetch.

        ``before`` is what :meth:`handled_request` returned before the last fetch request was made,
        if one was.
        """
        kustomization, source = objects.get(self.follower(domain)), self._source(domain, objects)
        # what does not exist or is suspended never fetches, and must not hold up the next request
        if kustomization is None or source is None:
            return True
        if any((each.get("spec") or {}).get("suspend") for each in (kustomization, source)):
            return True
        asked = (source["metadata"].get("annotations") or {}).get(REQUESTED_AT, "")
        handled = _handled(source)
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
        return worst([deployment_health(each) for each in self._deployments(target, objects)])

    def _service_state(self, status: Object) -> Object:
        return condition(status, "Ready")

    def _owns(self, target: Target, deployment: Object) -> bool:
        return (deployment["metadata"].get("labels") or {}).get(_HELM_NAME) == target.name


def _source_name(kustomization: Object) -> str:
    return str(((kustomization.get("spec") or {}).get("sourceRef") or {}).get("name", ""))


def _commit(revision: object) -> str:
    """Return the commit of a Flux revision (``main@sha1:…``)."""
    return str(revision or "").rpartition(":")[2]


def _handled(source: Object) -> str:
    return str((source.get("status") or {}).get("lastHandledReconcileAt", ""))
