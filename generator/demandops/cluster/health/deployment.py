"""The health of Deployments (apps/v1), and how to find a condition. Pure."""

from __future__ import annotations

from demandops.cluster.health.model import Health, Object, Objects, Target


def deployment_health(deployment: Object) -> Health:
    """Return whether all replicas of a Deployment are available with its current spec."""
    metadata, status = deployment["metadata"], deployment.get("status") or {}
    name = f"Deployment {metadata.get('namespace')}/{metadata.get('name')}"
    wanted = (deployment.get("spec") or {}).get("replicas", 1)
    current = status.get("observedGeneration", 0) >= metadata.get("generation", 0)
    updated, available = status.get("updatedReplicas", 0), status.get("availableReplicas", 0)
    if current and updated >= wanted and available >= wanted:
        return Health("healthy")
    for kind, bad in (("ReplicaFailure", "True"), ("Progressing", "False")):
        problem = condition(status, kind)
        if problem.get("status") == bad:
            message = str(problem.get("message", ""))
            return Health("reconciled", message, name, failing=True)
    return Health("reconciled", f"{available} of {wanted} replicas are available", name)


def client_health(target: Target, objects: Objects) -> Health:
    """Return the health of a communication client, from its Deployment."""
    namespace = target.domain.namespace
    deployment = objects.get(("Deployment", namespace, target.name))
    if deployment is None:
        return Health("reconciled", "does not exist yet", f"Deployment {namespace}/{target.name}")
    return deployment_health(deployment)


def condition(status: Object, kind: str) -> Object:
    """Return the condition of a type; empty if there is none."""
    conditions = status.get("conditions") or ()
    return next((item for item in conditions if item.get("type") == kind), {})
