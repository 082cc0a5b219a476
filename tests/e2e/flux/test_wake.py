"""What waking Flux is worth: a demand with `--clusters`, and one that waits for the next look."""

from __future__ import annotations

import base64
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from tests.e2e.common import expected
from tests.e2e.common.expected import STANDING
from tests.e2e.common.timing import Table, Times
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import Manifest, handled
from tests.e2e.rig.tools import Report

from .conftest import CLUSTER, MakeWorld
from .view import SOURCE, Domain
from .world import World

INTERVAL_S = 5.0
_RBAC = "rbac.authorization.k8s.io"
_ACCOUNT = "waker"


def test_a_wake_saves_the_wait_for_the_next_look(
    make_world: MakeWorld, rig: Rig, say: Report
) -> None:
    world = make_world()
    domain = world.bootstrap(CLUSTER, rig, interval=f"{INTERVAL_S:.0f}s")
    file = wake_file(world.folder, limited(domain, rig.kubeconfig, world.folder))
    took: dict[str, Times] = {}
    for way, arguments in (("woken", ("--clusters", str(file))), ("at the next look", ())):
        world.generator.start(*arguments)
        took[way] = demanded_right_after_a_look(world, domain)
        world.follow(world.demand(expected.demand(1) | {"shutdown": True}), STANDING)
        world.generator.stop()
    table = Table(f"Woken by the generator and not, interval {INTERVAL_S:.0f} s")
    for way, times in took.items():
        table.add(way, times)
    table.show(say)
    say(f"  the default interval is 1m: half a minute on average, here {INTERVAL_S:.0f} s at most")
    fetch = {way: times.fetched - times.pushed for way, times in took.items()}
    assert fetch["woken"] < INTERVAL_S / 2 < fetch["at the next look"]


def demanded_right_after_a_look(world: World, domain: Domain) -> Times:
    """Send a demand when the next look is nearly a whole interval away."""
    token = domain.kube.reconcile("GitRepository", SOURCE, domain.namespace)
    domain.kube.wait("a look", lambda: handled(domain.get("GitRepository", SOURCE), token))
    time.sleep(0.1)
    return world.step(1, expected.after(1), wake=False)


def wake_file(folder: Path, kubeconfig: Path) -> Path:
    """What the operator of the generator writes."""
    file = folder / "clusters.yaml"
    clusters = {CLUSTER: {"kubeconfig": str(kubeconfig)}}
    wake = {"apiVersion": "demandops/v1", "kind": "ClusterAccess", "clusters": clusters}
    file.write_text(yaml.safe_dump(wake))
    return file


WAKER = {
    "apiGroups": ["source.toolkit.fluxcd.io"],
    "resources": ["gitrepositories"],
    "verbs": ["patch"],
}


def limited(
    domain: Domain, administrator: Path, folder: Path, rules: Sequence[Manifest] = (WAKER,)
) -> Path:
    """A kubeconfig that has these rights in the domain's namespace and no others."""
    role = {"apiGroup": _RBAC, "kind": "Role", "name": _ACCOUNT}
    subject = {"kind": "ServiceAccount", "name": _ACCOUNT, "namespace": domain.namespace}
    domain.kube.apply(
        _object("v1", "ServiceAccount", domain),
        _object(f"{_RBAC}/v1", "Role", domain, rules=list(rules)),
        _object(f"{_RBAC}/v1", "RoleBinding", domain, roleRef=role, subjects=[subject]),
        _object("v1", "Secret", domain, type="kubernetes.io/service-account-token"),
    )
    token = domain.kube.wait(
        "a token", lambda: (domain.get("Secret", _ACCOUNT).get("data") or {}).get("token")
    )
    config = yaml.safe_load(administrator.read_text())
    config["users"] = [{"name": _ACCOUNT, "user": {"token": base64.b64decode(token).decode()}}]
    (context,) = [c for c in config["contexts"] if c["name"] == config["current-context"]]
    context["context"]["user"] = _ACCOUNT
    config["contexts"] = [context]
    file = folder / "waker.kubeconfig"
    file.write_text(yaml.safe_dump(config))
    return file


def _object(version: str, kind: str, domain: Domain, **rest: Any) -> dict[str, Any]:
    metadata: dict[str, Any] = {"name": _ACCOUNT, "namespace": domain.namespace}
    if kind == "Secret":
        metadata["annotations"] = {"kubernetes.io/service-account.name": _ACCOUNT}
    return {"apiVersion": version, "kind": kind, "metadata": metadata, **rest}
