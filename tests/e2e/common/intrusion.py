"""What a mistake or an attacker might commit to the folder of an access domain."""

from __future__ import annotations

from tests.e2e.rig.kube import Manifest, build_manifest

NEIGHBOUR = "neighbour"  # a namespace that belongs to no access domain
FILE = "clusters/c-its/perception/edge/foreign.yaml"
_RBAC = "rbac.authorization.k8s.io"


def binding(kind: str, namespace: str = "") -> Manifest:
    """Return a binding that makes the domain's account an administrator."""
    account = {"kind": "ServiceAccount", "name": "demandops", "namespace": "perception"}
    role = {"apiGroup": _RBAC, "kind": "ClusterRole", "name": "cluster-admin"}
    return build_manifest(f"{_RBAC}/v1", kind, "more", namespace, roleRef=role, subjects=[account])
