"""Fake nodes, which kwok reports as running, with their pods."""

from __future__ import annotations

from .kube import Manifest, build_manifest

NODE_ID_LABEL = "node_id"  # releases select nodes by it
_CAPACITY = {"cpu": "64", "memory": "256Gi", "ephemeral-storage": "1Ti", "pods": "1000"} | {
    "nvidia.com/gpu": "8"
}


def manifest(node_id: str) -> Manifest:
    """Return the Node of an inventory node; the annotation makes kwok manage it."""
    status = {"capacity": _CAPACITY, "allocatable": _CAPACITY}
    made = build_manifest("v1", "Node", node_id, status=status)
    made["metadata"] |= {
        "labels": {
            "kubernetes.io/hostname": node_id,
            "kubernetes.io/os": "linux",
            "type": "kwok",
            NODE_ID_LABEL: node_id,
        },
        "annotations": {"kwok.x-k8s.io/node": "fake", "node.alpha.kubernetes.io/ttl": "0"},
    }
    return made
