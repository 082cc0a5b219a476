"""Fake nodes, which kwok reports as running, with their pods.

A fake node represents a node of the inventory. It has the label `node_id`, which releases select,
and the annotation that makes kwok manage it, also in an existing cluster.
"""

from __future__ import annotations

import hashlib
import re
from typing import Any

from .errors import RigError

NODE_ID_LABEL = "node_id"
_FAKE = "kwok.x-k8s.io/node"
_LABEL_VALUE = re.compile(r"[A-Za-z0-9]([-A-Za-z0-9_.]{0,61}[A-Za-z0-9])?")
_CAPACITY = {"cpu": "64", "memory": "256Gi", "ephemeral-storage": "1Ti", "pods": "1000"}


def node_name(node_id: str) -> str:
    """Return the Kubernetes name for a node id; different ids get different names."""
    slug = re.sub(r"[^a-z0-9]+", "-", node_id.lower()).strip("-")
    if slug == node_id:
        return slug
    return f"{slug or 'node'}-{hashlib.sha256(node_id.encode()).hexdigest()[:6]}"


def manifest(node_id: str) -> dict[str, Any]:
    """Return the Node of an inventory node; raise RigError if its id is no valid label value."""
    if not _LABEL_VALUE.fullmatch(node_id):
        raise RigError(f"node {node_id!r}: not a label value; use letters, digits, '-', '_', '.'")
    name = node_name(node_id)
    common = {"kubernetes.io/hostname": name, "kubernetes.io/os": "linux", "type": "kwok"}
    return {
        "apiVersion": "v1",
        "kind": "Node",
        "metadata": {
            "name": name,
            "labels": {**common, NODE_ID_LABEL: node_id},
            "annotations": {_FAKE: "fake", "node.alpha.kubernetes.io/ttl": "0"},
        },
        "status": {"capacity": _CAPACITY, "allocatable": _CAPACITY},
    }
