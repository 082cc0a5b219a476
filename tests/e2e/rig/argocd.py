"""Argo CD's application-controller and repo-server, and their Redis, as plain processes.

One program takes both parts, by `ARGOCD_BINARY_NAME`. The controller runs as the cluster's
administrator; what a release may do is limited by its AppProject and by the service account that
is impersonated for it, as docs/argocd.md asks for. Redis is the machine's own `redis-server`.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from .errors import RigError
from .kube import Manifest
from .net import LOOPBACK, accepts, answers, free_port
from .processes import Component

NAMESPACE = "argocd"
KINDS = ("Application", "AppProject")
REMEDY = "install Argo CD there first, set up as docs/argocd.md says"
REDIS = "redis-server"
CONTROLLER = "argocd-application-controller"
REPO_SERVER = "argocd-repo-server"


def settings() -> list[Manifest]:
    """What both parts read from the API before they start: the lock-down of docs/argocd.md."""
    labels = {"app.kubernetes.io/part-of": "argocd"}
    return [
        {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NAMESPACE}},
        {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": "argocd-cm", "namespace": NAMESPACE, "labels": labels},
            "data": {"application.sync.impersonation.enabled": "true"},
        },
        {
            "apiVersion": "v1",
            "kind": "Secret",
            "metadata": {"name": "argocd-secret", "namespace": NAMESPACE, "labels": labels},
        },
    ]


def components(
    binaries: dict[str, Path], folder: Path, kubeconfig: Path, own: dict[str, list[str]]
) -> list[Component]:
    """Redis and the two parts; `own` holds further arguments by component name."""
    redis, repo_server, data = free_port(), free_port(), folder / "argocd"
    data.mkdir(parents=True, exist_ok=True)
    cache = f"--redis={LOOPBACK}:{redis}"
    controller = [
        f"--kubeconfig={kubeconfig}",
        f"--namespace={NAMESPACE}",
        cache,
        f"--repo-server={LOOPBACK}:{repo_server}",
        "--repo-server-plaintext",
        "--application-namespaces=*",
        # Tests wait for what this shortens: up to five minutes after repeated edits by hand.
        "--self-heal-backoff-cap-seconds=3",
    ]
    server = [
        cache,
        f"--address={LOOPBACK}",
        f"--port={repo_server}",
        f"--metrics-address={LOOPBACK}",
        "--disable-tls",
    ]
    environment = {
        "ARGOCD_FAKE_IN_CLUSTER": "true",  # "in the cluster" is what the kubeconfig names
        "ARGOCD_GPG_ENABLED": "false",
        "ARGOCD_PLUGINSOCKFILEPATH": str(data / "plugins"),
        "ARGOCD_SSH_DATA_PATH": str(data / "ssh"),
        "ARGOCD_TLS_DATA_PATH": str(data / "tls"),
        "KUBECONFIG": str(kubeconfig),
        "PATH": f"{binaries['helm'].parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}",
    }
    return [
        _redis(redis, data),
        _part(REPO_SERVER, binaries["argocd"], [*server, *own.get(REPO_SERVER, [])], environment),
        _part(CONTROLLER, binaries["argocd"], [*controller, *own.get(CONTROLLER, [])], environment),
    ]


def _redis(port: int, folder: Path) -> Component:
    program = shutil.which(REDIS)
    if program is None:
        raise RigError(
            f"`{REDIS}` is not on PATH: install Redis (Debian: the package redis-server)"
        )
    argv = [program, "--bind", LOOPBACK, "--port", str(port), "--dir", str(folder)]
    return Component(REDIS, (*argv, "--save", "", "--appendonly", "no"), accepts(port))


def _part(name: str, binary: Path, arguments: list[str], environment: dict[str, str]) -> Component:
    port = free_port()  # of its health; the controller's is on all addresses, it has no flag
    return Component(
        name,
        (str(binary), f"--metrics-port={port}", "--loglevel=info", *arguments),
        answers(port, "/healthz"),
        {**environment, "ARGOCD_BINARY_NAME": name},
    )
