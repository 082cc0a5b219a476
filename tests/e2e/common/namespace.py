"""An access domain's namespace on a cluster, as tests read it: names, pods, versions.

The `view` module of each controller adds what depends on the controller.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar

import yaml

from tests.e2e.rig.errors import RigError
from tests.e2e.rig.kube import Kube, Manifest
from tests.e2e.rig.kwok import NODE_ID_LABEL

from .expected import FUSION

_INSTANCE = "app.kubernetes.io/instance"

# Kinds that commits of the generator can create in a domain's namespace.
_OF_RELEASES = (
    *("ConfigMap", "Deployment", "Pod", "ReplicaSet", "Secret"),
    *("Role", "RoleBinding", "ServiceAccount"),
)
_OTHERS = ("Job", "Service")
_READY_POD = re.compile(
    r"pod of (?P<name>mqtt-derived-\S+|\S+?)(-[0-9a-f]{12})? on (?P<node>\S+), ready"
)

Pods = set[tuple[str, str]]
"""Pods, each as the name of its service, and its node.

The name has no hash, except for a client of a derived connection, whose topic may show only there.
"""


class Namespace:
    """An access domain's namespace; its releases are objects of the kind `RELEASE`."""

    RELEASE: ClassVar[str]
    OWN: ClassVar[tuple[str, ...]] = ()  # further kinds of the controller's objects
    STEADY: ClassVar[tuple[str, ...]] = ()  # kinds that a commit must not touch without need

    # What the view of each controller adds. The times are those of `time.monotonic`.
    all_in: ClassVar[Callable[..., list[Any]]]  # the domains that a bootstrap file lays down
    settle: Callable[[str], None]  # wait until the bootstrap file and a commit are applied
    remove: Callable[[], None]  # the controller's objects, with all releases
    wake: Callable[[], None]  # make the controller fetch from the remote now
    wait_fetched: Callable[[str], float]  # wait for a commit; return the time
    wait_applied: Callable[[str], float]
    wait_attempted: Callable[[str], None]  # wait until a commit is applied or refused
    wait_releases: Callable[[], None]  # until all are applied; their pods need not be ready
    wait_checked: Callable[[str], None]  # until every release was compared with a commit
    trouble: Callable[[str, str], str]  # why an object (kind, name) is not ready, or nothing
    folder_trouble: Callable[[], str]  # why the domain's folder cannot be applied, or nothing

    def __init__(self, kube: Kube, namespace: str, name: str) -> None:
        self.kube, self.namespace, self.name = kube, namespace, name
        self._node_ids: dict[str, str] = {}

    # --- reading ----------------------------------------------------------------------------

    def get(self, kind: str, name: str) -> Manifest:
        found = self.kube.get(kind, name, self.namespace)
        assert found is not None, f"{kind} {self.namespace}/{name} does not exist"
        return found

    def find(self, kind: str, instance: str = "") -> list[Manifest]:
        """Return the objects of a kind; with ``instance``, only those of this release."""
        selector = f"{_INSTANCE}={instance}" if instance else ""
        return self.kube.find(kind, self.namespace, selector)

    def lines(self) -> frozenset[str]:
        """Return the objects that exist, as lines that the module `expected` describes."""
        found = [f"release {name_of(item)}" for item in self.find(self.RELEASE)]
        found += [f"Deployment {name_of(item)}" for item in self.find("Deployment")]
        for config in self.find("ConfigMap"):
            found.append(f"ConfigMap {name_of(config)}")
            if name_of(config) == f"{FUSION}-params":
                found += [f"fusion takes {topic}" for topic in fusion_inputs(config)]
        found += [self._pod_line(pod) for pod in self.find("Pod")]
        repeated = {line for line in found if found.count(line) > 1}
        return frozenset(found) | {f"twice: {line}" for line in repeated}

    def pods(self) -> Pods:
        """Return the pods; one that is not ready is ``("?", "?")``."""
        lines = (line for line in self.lines() if line.startswith("pod of "))
        matches = map(_READY_POD.fullmatch, lines)
        return {(match["name"], match["node"]) if match else ("?", "?") for match in matches}

    def releases(self) -> dict[str, Any]:
        return {name_of(item): item["spec"] for item in self.find(self.RELEASE)}

    def inventory(self) -> frozenset[str]:
        """Return kind and name of everything in the namespace, whoever created it."""
        kinds = (*_OF_RELEASES, *_OTHERS, self.RELEASE, *self.OWN)
        return frozenset(f"{kind} {name_of(item)}" for kind in kinds for item in self.find(kind))

    def versions(self) -> dict[str, str]:
        """Return the resourceVersion of each release and of each object that it owns."""
        return {
            f"{kind} {name_of(item)}": item["metadata"]["resourceVersion"]
            for kind in (*_OF_RELEASES, *self.STEADY)
            for item in self.find(kind)
        }

    def identity(self, name: str) -> tuple[object, ...]:
        """Return what changes if a Deployment's pods restart or are about to restart."""
        metadata = self.get("Deployment", name)["metadata"]
        pods = sorted(pod["metadata"]["uid"] for pod in self.find("Pod", name))
        sets = sorted(item["metadata"]["uid"] for item in self.find("ReplicaSet", name))
        return metadata["uid"], metadata["generation"], *pods, *sets

    def uids(self) -> dict[str, tuple[object, ...]]:
        """Return `identity` of each Deployment, without the generation.

        It changes when another controller applies a Deployment and writes out a default value.
        """
        found = {}
        for item in self.find("Deployment"):
            uid, _, *below = self.identity(name_of(item))
            found[name_of(item)] = (uid, *below)
        return found

    # --- what the controller does -------------------------------------------------------------

    def read_chart(self, release: str) -> None:
        """Make the controller read a release's chart again, if it does not do so by itself."""

    def take_away(self, kind: str, name: str) -> None:
        self.kube.delete(kind, name, self.namespace)

    def restore(self, *releases: str) -> None:
        """Make the controller restore these releases, or without any the folder, if it must."""

    # --- waiting ----------------------------------------------------------------------------

    def wait_lines(self, wanted: frozenset[str]) -> float:
        """Wait until `lines` returns just the wanted lines; return the time (`time.monotonic`)."""
        return self._wait_same(self.lines, wanted)

    def wait_inventory(self, wanted: frozenset[str]) -> None:
        self._wait_same(self.inventory, wanted)

    def wait_refused(self, why: str, *releases: str) -> None:
        """Wait until the domain's folder, or one of these releases, reports a refusal."""

        def refused() -> bool:
            told = [self.folder_trouble(), *(self.trouble(self.RELEASE, name) for name in releases)]
            return any(why in text for text in told)

        self.kube.wait(f"'{why}' to be reported", refused)

    def wait_quiet(self, seconds: float = 1.0) -> dict[str, str]:
        """Wait until no release has changed for ``seconds``, nor its status; return `versions`."""
        seen, since = self.versions(), time.monotonic()

        def quiet() -> bool:
            nonlocal seen, since
            now = self.versions()
            if now != seen or not self._all_counted():
                seen, since = now, time.monotonic()
            return time.monotonic() - since > seconds

        self.kube.wait("the releases to stop changing", quiet, 60)
        return seen

    # --- inside -----------------------------------------------------------------------------

    def _all_counted(self) -> bool:
        return all(
            status.get("observedGeneration") == item["metadata"]["generation"]
            and status.get(counted, 0) == item["spec"]["replicas"]
            for kind in ("Deployment", "ReplicaSet")
            for item in self.find(kind)
            for status in (item.get("status", {}),)
            for counted in ("readyReplicas", "availableReplicas")
        )

    def _wait_same(self, look: Callable[[], frozenset[str]], wanted: frozenset[str]) -> float:
        seen: list[frozenset[str]] = [frozenset()]

        def same() -> bool:
            seen[0] = look()
            return seen[0] == wanted

        try:
            self.kube.wait("exactly what is wanted", same)
        except RigError as error:
            raise AssertionError(f"{error}\n{_difference(wanted, seen[0])}") from error
        return time.monotonic()

    def _status(self, kind: str, name: str) -> dict[str, Any]:
        found = self.kube.get(kind, name, self.namespace) or {}
        return dict(found.get("status") or {})

    def _pod_line(self, pod: Manifest) -> str:
        instance = (pod["metadata"].get("labels") or {}).get(_INSTANCE, name_of(pod))
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


def wait_for_pods(wanted: Mapping[Namespace, Pods]) -> None:
    """Wake the controller until each of these domains runs exactly its pods."""

    def same() -> bool:
        for domain in wanted:
            domain.wake()
        return all(domain.pods() == pods for domain, pods in wanted.items())

    listed = {domain.namespace: sorted(pods) for domain, pods in wanted.items()}
    next(iter(wanted)).kube.wait(f"exactly {listed}", same)


def fusion_inputs(config: Manifest) -> list[str]:
    (parameters,) = yaml.safe_load(config["data"]["params.yml"]).values()
    inputs = parameters["ros__parameters"]["additional_inputs"]
    return [topic for topic in inputs["topics_egodata"] + inputs["topics_objectlist"] if topic]


def name_of(item: Manifest) -> str:
    return str(item["metadata"]["name"])


def _difference(wanted: Iterable[str], found: Iterable[str]) -> str:
    lines = [f"  missing: {line}" for line in sorted(set(wanted) - set(found))]
    return "\n".join(lines + [f"  too much: {line}" for line in sorted(set(found) - set(wanted))])
