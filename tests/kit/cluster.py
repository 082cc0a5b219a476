"""Status objects as a cluster reports them, and a stand-in for the Git history."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


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


def deployment(name: str, *conditions: Any, of: str = "", **status: Any) -> dict[str, Any]:
    labels = {"helm.toolkit.fluxcd.io/name": of} if of else {}
    metadata = {"name": name, "namespace": "ns", "generation": 3, "labels": labels}
    whole = {"observedGeneration": 3, "updatedReplicas": 2, "availableReplicas": 2}
    found = whole | status | {"conditions": list(conditions)}
    return {"metadata": metadata, "spec": {"replicas": 2}, "status": found}
