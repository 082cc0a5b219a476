"""A generator that may watch and wake a cluster: its access file, its kubeconfig, its rights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import Kube, Manifest, build_manifest
from tests.kit.limits import PATIENCE_S

from .expected import CLUSTER
from .world import World

TIMEOUT_S = PATIENCE_S
"""How long an answer may wait for what happens by itself."""
_RBAC = "rbac.authorization.k8s.io"
_ACCOUNT = "generator"
_DEPLOY = Path(__file__).parents[3] / "deploy"


def limited_world(world: World, rig: Rig, **source: str) -> World:
    """Let the cluster follow a new state repo; its generator gets the rights of docs/status.md."""
    world.bootstrap(CLUSTER, rig, **source)
    rights = documented_roles(rig.gitops)
    kubeconfig = limited(rig.kube, rig.kubeconfig, world.folder, rights)
    access_file(world.folder, {CLUSTER: {"kubeconfig": kubeconfig}})
    restart_generator(world)
    return world


def restart_generator(world: World, timeout_s: float = TIMEOUT_S) -> None:
    """Start the generator anew; an answer waits so long for the cluster."""
    world.generator.stop()
    options = ("--clusters", str(world.folder / "clusters.yaml"))
    world.generator.start(*options, "--ros-args", "-p", f"answer_timeout:={timeout_s}")


def access_file(folder: Path, clusters: Mapping[str, Mapping[str, object]]) -> Path:
    file = folder / "clusters.yaml"
    access = {name: {key: str(one[key]) for key in one} for name, one in clusters.items()}
    content = {"apiVersion": "demandops/v1", "kind": "ClusterAccess", "clusters": access}
    file.write_text(yaml.safe_dump(content))
    return file


def documented_roles(gitops: str) -> dict[str, list[Manifest]]:
    """Return the role rules of deploy/ for a controller, by namespace."""
    roles = list(yaml.safe_load_all((_DEPLOY / f"status-role.{gitops}.yaml").read_text()))
    return {role["metadata"]["namespace"]: role["rules"] for role in roles}


def limited(
    kube: Kube, administrator: Path, folder: Path, rights: Mapping[str, Sequence[Manifest]]
) -> Path:
    """Create an account with these role rules by namespace; return the path of its kubeconfig."""
    home, *_ = rights
    subject = {"kind": "ServiceAccount", "name": _ACCOUNT, "namespace": home}
    role = {"apiGroup": _RBAC, "kind": "Role", "name": _ACCOUNT}
    kube.apply(build_manifest("v1", "ServiceAccount", _ACCOUNT, home))
    for namespace, rules in rights.items():
        kube.apply(
            build_manifest(f"{_RBAC}/v1", "Role", _ACCOUNT, namespace, rules=list(rules)),
            build_manifest(
                f"{_RBAC}/v1", "RoleBinding", _ACCOUNT, namespace, roleRef=role, subjects=[subject]
            ),
        )

    def in_force() -> bool:  # the API server applies new roles only a moment later
        return all(
            any({*rule["resources"]} <= {*found["resources"]} for found in granted)
            for namespace, rules in rights.items()
            for granted in [kube.rules(_ACCOUNT, namespace, home)]
            for rule in rules
        )

    kube.wait("the rights", in_force)
    config = yaml.safe_load(administrator.read_text())
    config["users"] = [{"name": _ACCOUNT, "user": {"token": kube.token(_ACCOUNT, home)}}]
    (context,) = [c for c in config["contexts"] if c["name"] == config["current-context"]]
    context["context"]["user"] = _ACCOUNT
    config["contexts"] = [context]
    file = folder / "generator.kubeconfig"
    file.write_text(yaml.safe_dump(config))
    return file
