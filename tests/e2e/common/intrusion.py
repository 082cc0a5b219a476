"""Manifests that a careless person or an attacker might commit to an access domain's folder."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tests.e2e.rig.kube import Manifest, build_manifest

NEIGHBOUR = "neighbour"  # a namespace that belongs to no access domain
FILE = "clusters/c-its/perception/edge/foreign.yaml"
_RBAC = "rbac.authorization.k8s.io"


_EDGE = {"node_id": "edge"}
_BY_POLICY = " is not possible with podSecurity: host-network of access domain 'perception'"
_ELSEWHERE = "no node selector of access domain 'perception': its pods run on its own nodes"


def _container(**context: Any) -> Manifest:
    return {"name": "foreign", "image": "example.org/foreign:1", "securityContext": context}


def pod(*containers: Manifest, **more: Any) -> Manifest:
    """Return the spec of a pod on the edge; `more` adds or replaces fields."""
    return {"nodeSelector": _EDGE, "containers": [*containers] or [_container()], **more}


ALLOWED = {
    "the host's network": pod(hostNetwork=True),
    "a usual capability": pod(_container(capabilities={"add": ["CHOWN"], "drop": ["ALL"]})),
    "a narrower selector": pod(nodeSelector={**_EDGE, "kubernetes.io/os": "linux"}),
    "volumes of a chart": pod(volumes=[{"name": "home", "emptyDir": {}}]),
}
FORBIDDEN = {
    "privileged": (pod(_container(privileged=True)), f"a privileged container{_BY_POLICY}"),
    "privileged at its start": (
        pod(initContainers=[{**_container(privileged=True), "name": "first"}]),
        f"a privileged container{_BY_POLICY}",
    ),
    "a folder of the host": (
        pod(volumes=[{"name": "root", "hostPath": {"path": "/"}}]),
        f"a hostPath volume{_BY_POLICY}",
    ),
    "processes of the host": (pod(hostPID=True), f"hostPID or hostIPC{_BY_POLICY}"),
    "memory of the host": (pod(hostIPC=True), f"hostPID or hostIPC{_BY_POLICY}"),
    "a capability": (
        pod(_container(capabilities={"add": ["SYS_ADMIN"]})),
        f"a capability beyond the usual ones{_BY_POLICY}",
    ),
    "unconfined": (
        pod(securityContext={"seccompProfile": {"type": "Unconfined"}}),
        f"an unconfined container (procMount, seccomp, AppArmor, SELinux){_BY_POLICY}",
    ),
    "another type for SELinux": (
        pod(_container(seLinuxOptions={"type": "spc_t"})),
        f"an unconfined container (procMount, seccomp, AppArmor, SELinux){_BY_POLICY}",
    ),
    "any node": (pod(nodeSelector={}), _ELSEWHERE),
    "a node of nobody": (pod(nodeSelector={"kubernetes.io/os": "linux"}), _ELSEWHERE),
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


def binding(kind: str, namespace: str = "") -> Manifest:
    """Return a binding of this kind that makes the domain's account an administrator."""
    account = {"kind": "ServiceAccount", "name": "demandops", "namespace": "perception"}
    role = {"apiGroup": _RBAC, "kind": "ClusterRole", "name": "cluster-admin"}
    return build_manifest(f"{_RBAC}/v1", kind, "more", namespace, roleRef=role, subjects=[account])
