"""Flux's source-, kustomize- and helm-controller as plain processes.

The controllers find the cluster by `KUBECONFIG`, because they have no flag for a kubeconfig. They
run as the cluster's administrator. For a release they impersonate the release's service account,
which limits what the release may do. As docs/flux.md requires, they are locked down: for an object
that names no service account, they impersonate the account `default` of the object's namespace.
"""

from __future__ import annotations

from pathlib import Path

from .kube import Manifest
from .net import LOOPBACK, answers, free_port
from .processes import Component

NAMESPACE = "flux-system"
LOCKED_DOWN = ("--no-cross-namespace-refs=true", "--default-service-account=default")
KINDS = ("GitRepository", "Kustomization", "HelmRelease")
REMEDY = "install Flux (source-, kustomize- and helm-controller) there first"
CONTROLLERS = ("source-controller", "kustomize-controller", "helm-controller")


def prerequisites() -> list[Manifest]:
    return [{"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NAMESPACE}}]


def components(binaries: dict[str, Path], folder: Path, kubeconfig: Path) -> list[Component]:
    storage = folder / "artifacts"
    storage.mkdir(parents=True, exist_ok=True)
    artifacts = f"{LOOPBACK}:{free_port()}"
    extra = {
        "source-controller": [
            f"--storage-path={storage}",
            f"--storage-addr={artifacts}",
            f"--storage-adv-addr={artifacts}",
        ],
        "kustomize-controller": ["--no-remote-bases=true", *LOCKED_DOWN],
        # By default helm-controller waits up to ten minutes for running releases before it ends.
        "helm-controller": ["--graceful-shutdown-timeout=5s", *LOCKED_DOWN],
    }
    return [_component(name, binaries[name], kubeconfig, extra[name]) for name in CONTROLLERS]


def _component(name: str, binary: Path, kubeconfig: Path, extra: list[str]) -> Component:
    port = free_port()
    argv = [
        str(binary),
        "--metrics-addr=0",
        f"--health-addr={LOOPBACK}:{port}",
        "--enable-leader-election=false",
        "--watch-all-namespaces=true",
        "--log-level=info",
        # These shorten the default waits: 30 s between checks of a dependency that is not ready;
        # 0.75 s after an object's first reconcile, which only sets the finalizer; up to 15 minutes
        # after repeated errors; and a random part of every interval.
        "--requeue-dependency=1s",
        "--min-retry-delay=50ms",
        "--max-retry-delay=5s",
        "--interval-jitter-percentage=0",
        "--kube-api-qps=200",
        "--kube-api-burst=400",
        *extra,
    ]
    environment = {"KUBECONFIG": str(kubeconfig), "RUNTIME_NAMESPACE": NAMESPACE}
    return Component(name, tuple(argv), answers(port, "/readyz"), environment)
