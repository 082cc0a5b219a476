"""The health of Deployments (apps/v1), and how to find a condition. Pure."""

from __future__ import annotations

from demandops.cluster.health.model import Health, Object


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


def condition(status: Object, kind: str) -> Object:
    """Return the condition of a type; empty if there is none."""
    conditions = status.get("conditions") or ()
    return next((item for item in conditions if item.get("type") == kind), {})
