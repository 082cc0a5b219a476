"""An access domain on a cluster, as tests see it: what exists there, and the GitOps controller.

`flux` and `argocd` add what depends on the controller, so that a behaviour is written once and
runs with both. Tests read the API and trigger the controller; they change no object that the
controller or a release owns, except to see it restored.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import yaml

from tests.e2e.rig import RigError
from tests.e2e.rig.kube import Kube, Manifest

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


class Domain:
    """An access domain's namespace; the object `name` of the kind `FOLDER` applies its folder."""

    # What each controller says of itself.
    RELEASE: ClassVar[str]  # the kind of a release
    FOLDER: ClassVar[str]
    OWN: ClassVar[tuple[str, ...]] = ()  # further kinds of the controller's objects
    STEADY: ClassVar[tuple[str, ...]] = ()  # kinds that a commit must not touch without need
    # its programs: what fetches commits, applies the folder, and installs a release
    FETCHER: ClassVar[str]
    APPLIER: ClassVar[str]
    INSTALLER: ClassVar[str]
    all_in: ClassVar[Callable[..., list[Any]]]  # the domains that a bootstrap file lays down
    settle: Callable[[str], None]  # wait until the bootstrap file and a commit are applied
    remove: Callable[[], None]  # the controller's objects, with all releases
    wake: Callable[[], None]  # make the controller fetch from the remote now
    fetched: Callable[[], str]  # the commit that was fetched last; empty if none
    applied: Callable[[], str]  # the commit that the folder is in sync with; empty if none
    trouble: Callable[[str, str], str]  # why an object (kind, name) is not ready, or nothing
    wait_attempted: Callable[[str], None]  # until a commit is applied or refused
    wait_checked: Callable[[str], None]  # until every release was compared with a commit
    wait_releases: Callable[[], None]  # until all are applied; their pods need not be ready

    def read_chart(self, release: str) -> None:
        """Make the controller read a release's chart again, if it does not do so by itself."""

    def take_away(self, kind: str, name: str) -> None:
        self.kube.delete(kind, name, self.namespace)

    def restore(self, *releases: str) -> None:
        """Make the controller restore these releases, or without any the folder, if it must."""

    def __init__(self, kube: Kube, namespace: str, name: str) -> None:
        self.kube, self.namespace, self.name = kube, namespace, name

    # --- reading ----------------------------------------------------------------------------

    def get(self, kind: str, name: str) -> Manifest:
        found = self.kube.get(kind, name, self.namespace)
        assert found is not None, f"{kind} {self.namespace}/{name} does not exist"
        return found

    def find(self, kind: str, instance: str = "") -> list[Manifest]:
        """Return the objects of a kind; with ``instance``, only those of this release."""
        selector = f"{_INSTANCE}={instance}" if instance else ""
        return self.kube.find(kind, self.namespace, selector)

    def names(self, kind: str) -> set[str]:
        return {name_of(item) for item in self.find(kind)}

    def lines(self) -> frozenset[str]:
        """Return the objects that exist, as lines that the module `expected` describes."""
        found = [f"release {name_of(item)}" for item in self.find(self.RELEASE)]
        found += [f"Deployment {name_of(item)}" for item in self.find("Deployment")]
        for config in self.find("ConfigMap"):
            found.append(f"ConfigMap {name_of(config)}")
            if name_of(config) == f"{FUSION}-params":
                found += [f"fusion takes {topic}" for topic in fusion_inputs(config)]
        found += map(_pod_line, self.find("Pod"))
        repeated = {line for line in found if found.count(line) > 1}
        return frozenset(found) | {f"twice: {line}" for line in repeated}

    def pods(self) -> Pods:
        """Return the pods; one that is not ready is ``("?", "?")``."""
        matches = map(_READY_POD.fullmatch, map(_pod_line, self.find("Pod")))
        return {(match["name"], match["node"]) if match else ("?", "?") for match in matches}

    def releases(self) -> dict[str, Any]:
        return {name_of(item): item["spec"] for item in self.find(self.RELEASE)}

    def inventory(self) -> frozenset[str]:
        """Return kind and name of everything in the namespace, whoever created it."""
        kinds = (*_OF_RELEASES, *_OTHERS, self.RELEASE, *self.OWN)
        return frozenset(f"{kind} {name}" for kind in kinds for name in self.names(kind))

    def identity(self, name: str) -> tuple[object, ...]:
        """Return what changes if a Deployment's pods restart or are about to restart."""
        return self.get("Deployment", name)["metadata"]["generation"], *self.uids()[name]

    def uids(self) -> dict[str, tuple[object, ...]]:
        """Return `identity` of each Deployment, without the generation.

        It changes when another controller applies a Deployment and writes out a default value.
        """
        return {
            name_of(item): (
                item["metadata"]["uid"],
                *sorted(pod["metadata"]["uid"] for pod in self.find("Pod", name_of(item))),
                *sorted(one["metadata"]["uid"] for one in self.find("ReplicaSet", name_of(item))),
            )
            for item in self.find("Deployment")
        }

    def pod_template(self, deployment: str) -> dict[str, Any]:
        return dict(self.get("Deployment", deployment)["spec"]["template"])

    # --- what a person may change by hand -----------------------------------------------------

    def change_image(self, deployment: str) -> None:
        containers = self.pod_template(deployment)["spec"]["containers"]
        containers[0]["image"] = "example.invalid/other:1"
        body = {"spec": {"template": {"spec": {"containers": containers}}}}
        self.kube.patch("Deployment", deployment, body, self.namespace)

    def overwrite(self, config: str, key: str) -> None:
        self.kube.patch("ConfigMap", config, {"data": {key: "by hand"}}, self.namespace)

    # --- waiting ----------------------------------------------------------------------------

    def wait_fetched(self, commit: str) -> None:
        self.wait(f"{commit[:10]} to be fetched", lambda: self.fetched() == commit)

    def wait_applied(self, commit: str) -> None:
        self.wait(f"{commit[:10]} to be applied", lambda: self.applied() == commit)

    def follow(self, commit: str) -> None:
        """Wake the controller, and wait until it has applied a commit."""
        self.wake()
        self.wait_applied(commit)

    def wait(self, what: str, look: Callable[[], bool]) -> None:
        """Wait for something that the controller does; on failure say what troubles it."""
        try:
            self.kube.wait(what, look)
        except RigError as error:
            raise AssertionError(
                f"{error}; {'; '.join(self._troubles(*self.releases()))}"
            ) from error

    def wait_refused(self, why: str, *releases: str) -> None:
        """Wait until the domain's folder, or one of these releases, reports a refusal."""
        self.kube.wait(f"'{why}'", lambda: any(why in told for told in self._troubles(*releases)))

    def _troubles(self, *releases: str) -> list[str]:
        kinds = {self.name: self.FOLDER} | dict.fromkeys(releases, self.RELEASE)
        return [told for name, kind in kinds.items() if (told := self.trouble(kind, name))]

    def wait_lines(self, wanted: frozenset[str]) -> None:
        """Wait until `lines` returns just the wanted lines."""
        self._wait_same(self.lines, wanted)

    def wait_inventory(self, wanted: frozenset[str]) -> None:
        self._wait_same(self.inventory, wanted)

    def _wait_same(self, look: Callable[[], frozenset[str]], wanted: frozenset[str]) -> None:
        seen: frozenset[str] = frozenset()

        def same() -> bool:
            nonlocal seen
            seen = look()
            return seen == wanted

        try:
            self.kube.wait("exactly what is wanted", same)
        except RigError as error:
            lines = [f"  missing: {line}" for line in sorted(wanted - seen)]
            lines += [f"  too much: {line}" for line in sorted(seen - wanted)]
            raise AssertionError("\n".join([str(error), *lines])) from error

    def wait_quiet(self, seconds: float = 1.0) -> dict[str, str]:
        """Wait until no release has changed for ``seconds``, nor its status.

        Return the resourceVersion of each release and of each object that it owns.
        """
        seen: dict[str, str] = {}
        since = time.monotonic()

        def quiet() -> bool:
            nonlocal seen, since
            now = {
                f"{kind} {name_of(item)}": item["metadata"]["resourceVersion"]
                for kind in (*_OF_RELEASES, *self.STEADY)
                for item in self.find(kind)
            }
            if now != seen or not self._all_counted():
                seen, since = now, time.monotonic()
            return time.monotonic() - since > seconds

        self.kube.wait("the releases to stop changing", quiet)
        return seen

    def _all_counted(self) -> bool:
        return all(
            status.get("observedGeneration") == item["metadata"]["generation"]
            and status.get(counted, 0) == item["spec"]["replicas"]
            for kind in ("Deployment", "ReplicaSet")
            for item in self.find(kind)
            for status in (item.get("status", {}),)
            for counted in ("readyReplicas", "availableReplicas")
        )

    def _status(self, kind: str, name: str) -> dict[str, Any]:
        found = self.kube.get(kind, name, self.namespace) or {}
        return dict(found.get("status") or {})


def wait_for_pods(wanted: Mapping[Domain, Pods]) -> None:
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


def _pod_line(pod: Manifest) -> str:
    instance = (pod["metadata"].get("labels") or {}).get(_INSTANCE, name_of(pod))
    conditions = pod.get("status", {}).get("conditions") or []
    ready = any(c["type"] == "Ready" and c["status"] == "True" for c in conditions)
    state = "going" if pod["metadata"].get("deletionTimestamp") else "not ready"
    state = "ready" if ready and state != "going" else state
    return f"pod of {instance} on {pod['spec'].get('nodeName') or 'no node'}, {state}"
