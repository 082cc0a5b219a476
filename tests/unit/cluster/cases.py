"""Status objects as a cluster reports them, tables of cases, and a stand-in for the Git history."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from demandops.cluster.health import Health

Case = dict[str, Any]
"""A row of a table in YAML: the objects in a cluster, and the health that they must give."""


class Letters:
    """A history of commits named by letters; ``changing`` has pairs of commit and changed path."""

    def __init__(self, changing: Iterable[tuple[str, str]] = ()) -> None:
        self._changing = list(changing)

    def includes(self, commit: str, other: str) -> bool:
        return commit >= other

    def unchanged(self, commit: str, other: str, path: str) -> bool:
        first, last = sorted((commit, other))
        return not any(first < one <= last and path == changed for one, changed in self._changing)


def condition(kind: str, status: str, message: str = "") -> dict[str, str]:
    at = "2026-05-04T12:00:00Z"
    return {"type": kind, "status": status, "message": message, "lastTransitionTime": at}


def deployments(case: Case) -> dict[tuple[str, str, str], dict[str, Any]]:
    """Return the Deployments of a case; ``tracked`` is Argo CD's name of what they belong to."""
    found = {}
    for name, fields in case.get("deployments", {}).items():
        status = {"observedGeneration": 3, "updatedReplicas": 2, "availableReplicas": 2} | fields
        status["conditions"] = [condition(*one) for one in status.get("conditions", ())]
        metadata = {"name": name, "namespace": "ns", "generation": status.pop("generation", 3)}
        of = status.pop("of", "")
        metadata["labels"] = {"helm.toolkit.fluxcd.io/name": of} if of else {}
        metadata["annotations"] = {"argocd.argoproj.io/tracking-id": status.pop("tracked", "")}
        spec = {"replicas": status.pop("replicas", 2)}
        found["Deployment", "ns", name] = {"metadata": metadata, "spec": spec, "status": status}
    return found


def told(health: Health, case: Case) -> Case:
    """Return the case with the health that was found; what differs is then shown as a whole."""
    found: Case = {**case, "state": health.state, "reason": health.reason, "object": health.object}
    if health.reason.startswith(case.get("reason", "-")):
        found["reason"] = case["reason"]
    if health.failing:
        found["failing"] = True
    return {
        name: value for name, value in found.items() if name in case or (value and name != "object")
    }
