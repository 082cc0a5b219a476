"""Manifests that a careless person or an attacker might commit to an access domain's folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from tests.e2e.rig.kube import Manifest, build_manifest

from .world import World

NEIGHBOUR = "neighbour"  # a namespace that belongs to no access domain
FOLDER = "clusters/c-its/perception"
FILE, BASE = f"{FOLDER}/edge/foreign.yaml", f"{FOLDER}/foreign/kustomization.yaml"
ELSEWHERE = "elsewhere"  # a folder that is not the domain's
_BY_POLICY = " is not possible with podSecurity: host-network of access domain 'perception'"
_PODS = yaml.safe_load(Path(__file__).with_name("pods.yaml").read_text())


def pod(container: Manifest | None = None, **fields: Any) -> Manifest:
    """Return the spec of a pod on the edge, with a container of this security context."""
    only = {"name": "foreign", "image": "example.org/foreign:1", "securityContext": container or {}}
    return {"nodeSelector": {"node_id": "edge"}, "containers": [only], **fields}


ALLOWED = {name: pod(**fields) for name, fields in _PODS["allowed"].items()}
FORBIDDEN = {
    name: (pod(**fields), reason.replace("…", _BY_POLICY))
    for reason, pods in _PODS["forbidden"].items()
    for name, fields in pods.items()
}
"""Pod specs that the skeleton's access domain must refuse, each with the refusal's reason."""


def makers(spec: Manifest) -> Iterator[Manifest]:
    """Yield one object of each kind that makes pods; each object makes pods with this spec."""
    labels = {"app": "foreign"}
    template = {"metadata": {"labels": labels}, "spec": spec}
    once = {"template": {**template, "spec": {**spec, "restartPolicy": "Never"}}}
    several = {"selector": {"matchLabels": labels}, "template": template}
    yield build_manifest("v1", "Pod", "foreign", "perception", spec=spec)
    for kind in ("Deployment", "DaemonSet", "StatefulSet"):
        more = {"serviceName": "foreign"} if kind == "StatefulSet" else {}
        yield build_manifest("apps/v1", kind, "foreign", "perception", spec={**several, **more})
    yield build_manifest("batch/v1", "Job", "foreign", "perception", spec=once)
    cron = {"schedule": "0 0 * * *", "jobTemplate": {"spec": once}}
    yield build_manifest("batch/v1", "CronJob", "foreign", "perception", spec=cron)


def config(name: str, namespace: str) -> Manifest:
    return build_manifest("v1", "ConfigMap", name, namespace, data={"made": "by hand"})


def withdraw(world: World) -> None:
    """Remove the committed files that still exist, and wait until the removal is applied."""
    while left := world.git("ls-files", FILE, BASE, ELSEWHERE).split():
        with suppress(FileNotFoundError):  # the generator removed one meanwhile
            world.push(dict.fromkeys(left))
    world.domain.follow(world.tip())
