"""One access domain on one cluster, as tests look at it: names, pods, versions, and waiting.

It reads the API and asks Flux to look; it changes nothing that Flux or a release owns.
"""

from __future__ import annotations

import tarfile
import time
import urllib.request
from collections.abc import Callable, Iterable
from typing import Any

import yaml

from tests.e2e.rig.errors import RigError
from tests.e2e.rig.kube import Kube, Manifest
from tests.e2e.rig.kwok import NODE_ID_LABEL

from .expected import FUSION

SOURCE = "demandops"  # the GitRepository's name
_INSTANCE = "app.kubernetes.io/instance"

# What can be in a domain's namespace by way of us; events, leases and the like are left out.
_OF_RELEASES = (
    "ConfigMap",
    "Deployment",
    "HelmRelease",
    "Pod",
    "ReplicaSet",
    "Role",
    "RoleBinding",
    "Secret",
    "ServiceAccount",
)
_KINDS = (*_OF_RELEASES, "GitRepository", "HelmChart", "Job", "Kustomization", "Service")


class Domain:
    """The domain's namespace on one cluster; its Kustomization is called `name`."""

    def __init__(self, kube: Kube, namespace: str, name: str) -> None:
        self.kube, self.namespace, self.name = kube, namespace, name
        self._node_ids: dict[str, str] = {}

    # --- looking ----------------------------------------------------------------------------

    def get(self, kind: str, name: str) -> Manifest:
        """An object that must be there."""
        found = self.kube.get(kind, name, self.namespace)
        assert found is not None, f"{kind} {self.namespace}/{name} is not there"
        return found

    def find(self, kind: str, instance: str = "") -> list[Manifest]:
        """The namespace's objects of a kind, or those of one release."""
        selector = f"{_INSTANCE}={instance}" if instance else ""
        return self.kube.find(kind, self.namespace, selector)

    def lines(self) -> frozenset[str]:
        """What is there, in the words of `expected`."""
        found = [f"HelmRelease {_name(item)}" for item in self.find("HelmRelease")]
        found += [f"Deployment {_name(item)}" for item in self.find("Deployment")]
        for config in self.find("ConfigMap"):
            found.append(f"ConfigMap {_name(config)}")
            if _name(config) == f"{FUSION}-params":
                found += [f"fusion takes {topic}" for topic in fusion_inputs(config)]
        found += [self._pod_line(pod) for pod in self.find("Pod")]
        repeated = {line for line in found if found.count(line) > 1}
        return frozenset(found) | {f"twice: {line}" for line in repeated}

    def inventory(self) -> frozenset[str]:
        """Kind and name of everything in the namespace, whoever made it."""
        return frozenset(f"{kind} {_name(item)}" for kind in _KINDS for item in self.find(kind))

    def versions(self) -> dict[str, str]:
        """The resourceVersion of every object that a release is or owns."""
        return {
            f"{kind} {_name(item)}": item["metadata"]["resourceVersion"]
            for kind in _OF_RELEASES
            for item in self.find(kind)
        }

    def identity(self, name: str) -> tuple[object, ...]:
        """What changes when the pods of a Deployment are restarted, or were about to be."""
        metadata = self.get("Deployment", name)["metadata"]
        pods = sorted(pod["metadata"]["uid"] for pod in self.find("Pod", name))
        sets = sorted(item["metadata"]["uid"] for item in self.find("ReplicaSet", name))
        return metadata["uid"], metadata["generation"], *pods, *sets

    def applied(self) -> str:
        """The commit that the Kustomization has applied."""
        return _commit(self._status("Kustomization", self.name).get("lastAppliedRevision"))

    def fetched(self) -> str:
        """The commit that the source has fetched."""
        return _commit(self._status("GitRepository", SOURCE).get("artifact", {}).get("revision"))

    def fetched_files(self) -> list[str]:
        """The paths of what the source has fetched, where its address can be reached from here."""
        url = self._status("GitRepository", SOURCE)["artifact"]["url"]
        with (
            urllib.request.urlopen(url, timeout=60) as answer,  # noqa: S310 - the source's own
            tarfile.open(fileobj=answer, mode="r|gz") as archive,
        ):
            return [member.name for member in archive if member.isfile()]

    def trouble(self, kind: str, name: str) -> str:
        """Why an object is not ready; empty where it is or has not said yet."""
        conditions = self._status(kind, name).get("conditions") or []
        told = [c["message"] for c in conditions if c["type"] == "Ready" and c["status"] == "False"]
        return " ".join(told)

    # --- waiting ----------------------------------------------------------------------------

    def wake(self) -> None:
        """Ask the source to look now; its new artifact wakes the Kustomization."""
        self.kube.reconcile("GitRepository", SOURCE, self.namespace)

    def wait_fetched(self, commit: str, timeout: float = 60.0) -> float:
        """Wait until the source has fetched a commit; returns when it was seen."""
        self._wait_for(f"{commit[:10]} to be fetched", lambda: self.fetched() == commit, timeout)
        return time.monotonic()

    def wait_applied(self, commit: str, timeout: float = 60.0) -> float:
        """Wait until the Kustomization has applied a commit; returns when it was seen."""
        self._wait_for(f"{commit[:10]} to be applied", lambda: self.applied() == commit, timeout)
        return time.monotonic()

    def wait_attempted(self, commit: str, timeout: float = 60.0) -> None:
        """Wait until the Kustomization has tried a commit, whatever came of it."""

        def attempted() -> bool:
            status = self._status("Kustomization", self.name)
            return _commit(status.get("lastAttemptedRevision")) == commit

        self._wait_for(f"{commit[:10]} to be tried", attempted, timeout)

    def wait_lines(self, wanted: frozenset[str], timeout: float = 60.0) -> float:
        """Wait until there is exactly what is wanted; returns when it was seen."""
        return self._wait_same(self.lines, wanted, timeout)

    def wait_inventory(self, wanted: frozenset[str], timeout: float = 60.0) -> None:
        """Wait until the namespace holds exactly what it held when `inventory` was asked."""
        self._wait_same(self.inventory, wanted, timeout)

    def wait_quiet(self, seconds: float = 1.0) -> dict[str, str]:
        """Wait until no release's object has changed for a while; returns the versions."""
        seen, since = self.versions(), time.monotonic()

        def quiet() -> bool:
            nonlocal seen, since
            now = self.versions()
            if now != seen:
                seen, since = now, time.monotonic()
            return time.monotonic() - since > seconds

        self.kube.wait("the releases to come to rest", quiet, 60)
        return seen

    def wait_releases_ready(self) -> None:
        """Wait until Helm has done all that was asked of it."""
        for release in self.find("HelmRelease"):
            self.kube.wait_ready("HelmRelease", _name(release), self.namespace)

    def _wait_same(
        self, look: Callable[[], frozenset[str]], wanted: frozenset[str], timeout: float
    ) -> float:
        seen: list[frozenset[str]] = [frozenset()]

        def same() -> bool:
            seen[0] = look()
            return seen[0] == wanted

        try:
            self.kube.wait("exactly what is wanted", same, timeout)
        except RigError as error:
            raise AssertionError(f"{error}\n{_difference(wanted, seen[0])}") from error
        return time.monotonic()

    def _wait_for(self, what: str, look: Callable[[], bool], timeout: float) -> None:
        try:
            self.kube.wait(what, look, timeout)
        except RigError as error:
            told = [self.trouble("GitRepository", SOURCE), self.trouble("Kustomization", self.name)]
            raise AssertionError(f"{error}; {'; '.join(filter(None, told))}") from error

    # --- inside -----------------------------------------------------------------------------

    def _status(self, kind: str, name: str) -> dict[str, Any]:
        found = self.kube.get(kind, name, self.namespace) or {}
        return dict(found.get("status") or {})

    def _pod_line(self, pod: Manifest) -> str:
        instance = (pod["metadata"].get("labels") or {}).get(_INSTANCE, _name(pod))
        conditions = pod.get("status", {}).get("conditions") or []
        ready = any(c["type"] == "Ready" and c["status"] == "True" for c in conditions)
        state = "going" if pod["metadata"].get("deletionTimestamp") else "not ready"
        state = "ready" if ready and state != "going" else state
        return f"pod of {instance} on {self._node_id(pod['spec'].get('nodeName'))}, {state}"

    def _node_id(self, node: str | None) -> str:
        if node is None:
            return "no node"
        if node not in self._node_ids:
            found = self.kube.get("Node", node) or {"metadata": {}}
            labels = found["metadata"].get("labels") or {}
            self._node_ids[node] = labels.get(NODE_ID_LABEL, f"{node} without label")
        return self._node_ids[node]


def fusion_inputs(config: Manifest) -> list[str]:
    """The topics that the fusion's ConfigMap tells it to take."""
    (parameters,) = yaml.safe_load(config["data"]["params.yml"]).values()
    inputs = parameters["ros__parameters"]["additional_inputs"]
    return [topic for topic in inputs["topics_egodata"] + inputs["topics_objectlist"] if topic]


def _name(item: Manifest) -> str:
    return str(item["metadata"]["name"])


def _commit(revision: str | None) -> str:
    """The commit in a Flux revision (`main@sha1:…`)."""
    return (revision or "").rpartition(":")[2]


def _difference(wanted: Iterable[str], found: Iterable[str]) -> str:
    lines = [f"  missing: {line}" for line in sorted(set(wanted) - set(found))]
    return "\n".join(lines + [f"  too much: {line}" for line in sorted(set(found) - set(wanted))])
