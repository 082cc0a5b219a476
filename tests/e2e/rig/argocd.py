"""Argo CD's application-controller, repo-server and server, and their Redis, as plain processes.

One program contains all three parts; `ARGOCD_BINARY_NAME` selects one. The server serves the
webhook. The controller runs as the cluster's administrator. As docs/argocd.md requires, two limits
hold for a release: its AppProject, and the rights of the service account that the controller
impersonates for the release. Redis is the machine's own `redis-server`.
"""

from __future__ import annotations

import base64
import os
import secrets
import shutil
from pathlib import Path

from .errors import RigError
from .kube import Manifest, build_manifest
from .net import LOOPBACK, accepts, answers, free_port, url
from .processes import Component

NAMESPACE = "argocd"
KINDS = ("Application", "AppProject")
REMEDY = "install Argo CD there first, set up as docs/argocd.md says"
REDIS = "redis-server"
CONTROLLER = "argocd-application-controller"
REPO_SERVER = "argocd-repo-server"
SERVER = "argocd-server"
WEBHOOK_SECRET = secrets.token_hex(16)
"""The secret that signs calls of Argo CD's webhook."""


def prerequisites() -> list[Manifest]:
    """Return the manifests that Argo CD's parts need before they start, as docs/argocd.md says."""
    secret = base64.b64encode(WEBHOOK_SECRET.encode()).decode()
    made = [
        build_manifest("v1", "Namespace", NAMESPACE),
        build_manifest(
            "v1",
            "ConfigMap",
            "argocd-cm",
            NAMESPACE,
            data={"application.sync.impersonation.enabled": "true"},
        ),
        build_manifest(
            "v1", "Secret", "argocd-secret", NAMESPACE, data={"webhook.github.secret": secret}
        ),
    ]
    for manifest in made[1:]:
        manifest["metadata"]["labels"] = {"app.kubernetes.io/part-of": "argocd"}
    return made


def components(binaries: dict[str, Path], folder: Path, kubeconfig: Path) -> list[Component]:
    redis, repo_server, server_port, data = free_port(), free_port(), free_port(), folder / "argocd"
    data.mkdir(parents=True, exist_ok=True)
    cache = f"--redis={LOOPBACK}:{redis}"
    manifests = [cache, f"--address={LOOPBACK}", f"--port={repo_server}", "--disable-tls"]
    manifests.append(f"--metrics-address={LOOPBACK}")
    both = [
        f"--kubeconfig={kubeconfig}",
        f"--namespace={NAMESPACE}",
        cache,
        f"--repo-server={LOOPBACK}:{repo_server}",
        "--repo-server-plaintext",
        "--application-namespaces=*",
    ]
    # Shortens a wait of up to five minutes after repeated manual changes.
    controller = [*both, "--self-heal-backoff-cap-seconds=3"]
    server = [*both, f"--address={LOOPBACK}", f"--port={server_port}", "--insecure"]
    server.append(f"--metrics-address={LOOPBACK}")
    environment = {
        "ARGOCD_FAKE_IN_CLUSTER": "true",  # "in-cluster" then means the kubeconfig's cluster
        "ARGOCD_GPG_ENABLED": "false",
        "ARGOCD_PLUGINSOCKFILEPATH": str(data / "plugins"),
        "ARGOCD_SSH_DATA_PATH": str(data / "ssh"),
        "ARGOCD_TLS_DATA_PATH": str(data / "tls"),
        "KUBECONFIG": str(kubeconfig),
        "PATH": f"{binaries['helm'].parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}",
    }
    program = binaries["argocd"]
    parts = [
        _part(REPO_SERVER, program, manifests, environment),
        _part(CONTROLLER, program, controller, environment),
        _part(SERVER, program, server, environment, server_port),
    ]
    return [_redis(redis, data), *parts]


def _redis(port: int, folder: Path) -> Component:
    program = shutil.which(REDIS)
    if program is None:
        raise RigError(f"`{REDIS}` is not on PATH: install Redis (Debian: redis-server)")
    argv = [program, "--bind", LOOPBACK, "--port", str(port), "--dir", str(folder)]
    return Component(REDIS, (*argv, "--save", "", "--appendonly", "no"), accepts(port))


def _part(
    name: str,
    binary: Path,
    arguments: list[str],
    environment: dict[str, str],
    serves: int | None = None,
) -> Component:
    # this port listens on all addresses, because the controller has no flag for the address
    port = free_port()
    return Component(
        name,
        (str(binary), f"--metrics-port={port}", "--loglevel=info", *arguments),
        answers(serves or port, "/healthz"),
        {**environment, "ARGOCD_BINARY_NAME": name},
        url=url(serves) if serves else "",
    )
