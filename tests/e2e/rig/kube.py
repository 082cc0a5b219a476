"""A cluster's API: apply, read, wait. The rig's only module that imports `kubernetes`.

Objects are plain dictionaries, like their manifests. A wait polls often until its deadline. If it
fails, the error contains the last state that the wait saw.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import yaml
from kubernetes.client.api.authorization_v1_api import AuthorizationV1Api
from kubernetes.client.api.core_v1_api import CoreV1Api
from kubernetes.client.api_client import ApiClient
from kubernetes.client.configuration import Configuration
from kubernetes.client.exceptions import ApiException
from kubernetes.config.kube_config import load_kube_config
from kubernetes.dynamic.client import DynamicClient
from kubernetes.dynamic.exceptions import NotFoundError
from urllib3.exceptions import HTTPError

from tests.kit.limits import PATIENCE_S

from . import RigError

Manifest = dict[str, Any]
Seen = TypeVar("Seen")

_MANAGER = "demandops-e2e"
_POLL_SECONDS = 0.1
_VERSIONS = {
    "Application": "argoproj.io/v1alpha1",
    "AppProject": "argoproj.io/v1alpha1",
    "GitRepository": "source.toolkit.fluxcd.io/v1",
    "HelmChart": "source.toolkit.fluxcd.io/v1",
    "HelmRelease": "helm.toolkit.fluxcd.io/v2",
    "Kustomization": "kustomize.toolkit.fluxcd.io/v1",
    "CustomResourceDefinition": "apiextensions.k8s.io/v1",
    "Deployment": "apps/v1",
    "HorizontalPodAutoscaler": "autoscaling/v2",
    "Lease": "coordination.k8s.io/v1",
    "ReplicaSet": "apps/v1",
    "Job": "batch/v1",
    "Role": "rbac.authorization.k8s.io/v1",
    "RoleBinding": "rbac.authorization.k8s.io/v1",
}


class Kube:
    """A cluster's API; without `version`, a kind's is that of `_VERSIONS`, or `v1`."""

    def __init__(
        self, kubeconfig: Path, cache: Path, check: Callable[[], None] = lambda: None
    ) -> None:
        settings = Configuration()
        load: Any = load_kube_config  # not annotated in some versions of the library
        load(config_file=str(kubeconfig), client_configuration=settings)
        self.api: Any = ApiClient(settings)
        self._cache, self._check = cache, check
        self._dynamic: Any = None

    def close(self) -> None:
        self.api.close()

    def apply(self, *manifests: Manifest, dry_run: bool = False) -> None:
        """Apply manifests; in a dry run the server checks everything and stores nothing."""
        for manifest in manifests:
            meta = manifest["metadata"]
            self._resource(manifest["kind"], manifest["apiVersion"]).server_side_apply(
                body=manifest,
                name=meta["name"],
                namespace=meta.get("namespace"),
                field_manager=_MANAGER,
                force_conflicts=True,
                dry_run="All" if dry_run else None,
            )

    def refusal(self, manifest: Manifest) -> str:
        """Return why the server would refuse a manifest; empty if it would accept it."""
        try:
            self.apply(manifest, dry_run=True)
        except ApiException as error:
            return str(error.body)
        return ""

    def get(self, kind: str, name: str, namespace: str = "", version: str = "") -> Manifest | None:
        try:
            found = self._resource(kind, version).get(name=name, namespace=namespace or None)
        except NotFoundError:
            return None
        return dict(found.to_dict())

    def find(self, kind: str, namespace: str = "", selector: str = "") -> list[Manifest]:
        """Return the objects of a kind that match a label selector, in one namespace or in all."""
        found = self._resource(kind).get(
            namespace=namespace or None, label_selector=selector or None
        )
        return [dict(item) for item in found.to_dict()["items"]]

    def delete(self, kind: str, name: str, namespace: str = "", version: str = "") -> None:
        try:
            self._resource(kind, version).delete(name=name, namespace=namespace or None)
        except NotFoundError:
            return

    def patch(self, kind: str, name: str, body: Manifest, namespace: str = "") -> None:
        self._resource(kind).patch(
            name=name,
            namespace=namespace or None,
            body=body,
            content_type="application/merge-patch+json",
        )

    def scale(self, name: str, replicas: int, namespace: str = "") -> None:
        """Set a Deployment's replicas through the scale subresource, as an autoscaler does."""
        self._resource("Deployment").scale.patch(
            name=name,
            namespace=namespace or None,
            body={"spec": {"replicas": replicas}},
            content_type="application/merge-patch+json",
        )

    def token(self, account: str, namespace: str) -> str:
        """Return a new token of a service account, as a kubelet gets it for a pod."""
        call: Any = CoreV1Api(self.api).create_namespaced_service_account_token
        return str(call(account, namespace, {"spec": {"expirationSeconds": 3607}}).status.token)

    def rules(self, account: str, namespace: str, home: str = "") -> list[Manifest]:
        """Return the rules of a namespace for an account, whose own namespace is `home`."""
        who = f"system:serviceaccount:{home or namespace}:{account}"
        api: Any = ApiClient(self.api.configuration, "Impersonate-User", who)
        call: Any = AuthorizationV1Api(api).create_self_subject_rules_review
        review = api.sanitize_for_serialization(call({"spec": {"namespace": namespace}}))
        return list(review["status"]["resourceRules"])

    def reconcile(self, kind: str, name: str, namespace: str) -> None:
        annotations = {"reconcile.fluxcd.io/requestedAt": f"{time.time():.6f}"}
        self.patch(kind, name, {"metadata": {"annotations": annotations}}, namespace)

    def wait(self, what: str, look: Callable[[], Seen | None], timeout: float = PATIENCE_S) -> Seen:
        """Return the first result of `look` that is neither None nor False.

        Raises RigError after `timeout` seconds, or at once if a part of the rig has died.
        """
        deadline = time.monotonic() + timeout
        while True:
            trouble = ""
            try:
                if (seen := look()) is not None and seen is not False:
                    return seen
            except (ApiException, HTTPError, OSError) as error:  # a test may restart the server
                trouble = f"; last error: {error}"
            self._check()
            if time.monotonic() > deadline:
                raise RigError(f"waited {timeout:.0f} s for {what}{trouble}")
            time.sleep(_POLL_SECONDS)

    def wait_ready(self, kind: str, name: str, namespace: str = "") -> None:
        last = "does not exist"

        def ready() -> bool:
            nonlocal last
            last = _condition(self.get(kind, name, namespace))
            return last == ""

        try:
            self.wait(f"{kind} {namespace}/{name} to be Ready", ready)
        except RigError as error:
            raise RigError(f"{error}; last seen: {last}") from error

    def wait_gone(self, kind: str, name: str, namespace: str = "") -> None:
        what = f"{kind} {namespace}/{name} to go"
        self.wait(what, lambda: self.get(kind, name, namespace) is None)

    def install_crds(self, files: Iterable[Path]) -> None:
        """Apply CRDs and wait until the server serves them."""
        parsed = (yaml.safe_load_all(path.read_text()) for path in files)
        crds = [crd for documents in parsed for crd in documents if crd]
        self.apply(*crds)
        for name in (crd["metadata"]["name"] for crd in crds):
            self.wait(
                f"CRD {name} to be served",
                lambda name=name: _holds(
                    self.get("CustomResourceDefinition", name) or {}, "Established"
                ),
            )

    def _resource(self, kind: str, version: str = "") -> Any:
        if self._dynamic is None:  # not earlier, because it queries the server
            connect: Any = DynamicClient
            self._dynamic = connect(self.api, cache_file=str(self._cache))
        version = version or _VERSIONS.get(kind, "v1")
        return self._dynamic.resources.get(api_version=version, kind=kind)


def build_manifest(
    version: str, kind: str, name: str, namespace: str = "", **fields: Any
) -> Manifest:
    """Return a manifest with further `fields`; without a namespace the object is cluster-wide."""
    metadata = {"name": name} | ({"namespace": namespace} if namespace else {})
    return {"apiVersion": version, "kind": kind, "metadata": metadata, **fields}


def _condition(found: Manifest | None) -> str:
    """Return why the newest generation of an object is not ready; empty if it is."""
    if found is None:
        return "does not exist"
    status, generation = found.get("status", {}), found["metadata"].get("generation")
    observed = status.get("observedGeneration", generation)
    if observed == generation and _holds(found, "Ready"):
        return ""
    return f"generation {observed} of {generation}: {status.get('conditions')}"


def _holds(found: Manifest, kind: str) -> bool:
    conditions = found.get("status", {}).get("conditions") or []
    return any(c["type"] == kind and c["status"] == "True" for c in conditions)
