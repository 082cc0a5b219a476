"""The rig's programs as `Component`s, from the table `components.yaml`; this starts nothing."""

from __future__ import annotations

import base64
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from . import RigError
from .kube import Manifest, build_manifest
from .net import accepts, answers, free_port
from .pki import Pki
from .processes import Component

ARGOCD = "argocd"  # its namespace
ARGOCD_SERVER = "argocd-server"
WEBHOOK_SECRET = secrets.token_hex(16)
"""The secret that signs calls of Argo CD's webhook."""
_HERE = Path(__file__).resolve().parent
_TABLE: dict[str, Any] = yaml.safe_load((_HERE / "components.yaml").read_text())


class Components(dict[str, Any]):
    """The names that the table uses; a name that ends in `_port` gets a free port at first use."""

    def __init__(self, binaries: dict[str, Path], folder: Path, certificates: Pki) -> None:
        path = f"{binaries['helm'].parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
        super().__init__(**vars(certificates), folder=folder, here=_HERE, path_with_helm=path)
        self["kubeconfig"] = folder / "kubeconfig"
        self._binaries = binaries

    def __missing__(self, name: str) -> int:
        if not name.endswith("_port"):
            raise KeyError(name)
        self[name] = free_port()
        return int(self[name])

    def of(self, group: str) -> Iterator[Component]:
        """Yield the components of a group, which start together."""
        for folder in ("artifacts", "argocd"):
            (self["folder"] / folder).mkdir(exist_ok=True)
        for name, row in _TABLE[group].items():
            self |= {"name": name, "own_port": free_port()}
            ready = row["ready"]
            port, authority = int(self._fill(ready["port"])), self["authority"]
            path = ready.get("path")
            probe = answers(port, path, authority if "tls" in ready else None) if path else None
            arguments = [*row.get("common", ()), *row["arguments"]]
            yield Component(
                name,
                (self._program(row.get("program", name)), *map(self._fill, arguments)),
                probe or accepts(port),
                {key: self._fill(value) for key, value in row.get("environment", {}).items()},
                url=self._fill(row.get("url", "")),
            )

    def _fill(self, text: str) -> str:
        return text.format_map(self)

    def _program(self, name: str) -> str:
        if name in self._binaries:
            return str(self._binaries[name])
        if found := shutil.which(name):
            return found
        raise RigError(f"`{name}` is not on PATH: install Redis (Debian: the package {name})")


def prerequisites(gitops: str) -> list[Manifest]:
    """Return the manifests that a controller needs before it starts, as docs/argocd.md says."""
    if gitops == "flux":
        return [build_manifest("v1", "Namespace", "flux-system")]
    settings = {"application.sync.impersonation.enabled": "true"}
    secret = {"webhook.github.secret": base64.b64encode(WEBHOOK_SECRET.encode()).decode()}
    made = [
        build_manifest("v1", "ConfigMap", "argocd-cm", ARGOCD, data=settings),
        build_manifest("v1", "Secret", "argocd-secret", ARGOCD, data=secret),
    ]
    for manifest in made:
        manifest["metadata"]["labels"] = {"app.kubernetes.io/part-of": "argocd"}
    return [build_manifest("v1", "Namespace", ARGOCD), *made]
