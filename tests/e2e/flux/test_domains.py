"""An access domain's service account can change only the domain's own namespace.

Each case commits to the domain's folder what a careless person or an attacker might commit.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.common import expected
from tests.e2e.common.expected import CLUSTER
from tests.e2e.common.intrusion import (
    ALLOWED,
    BASE,
    FORBIDDEN,
    NEIGHBOUR,
    binding,
    config,
    makers,
    pod,
    privileged_deployment,
    withdraw,
)
from tests.e2e.common.world import World
from tests.e2e.conftest import SlipIn
from tests.e2e.rig.clone import Clone
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import Manifest, build_manifest

from .view import Domain

NODES, POLICY = "inventory/nodes.yaml", "policy/access-domains.yaml"
CHART = {"kind": "HelmChart", "name": "object-detection-0.1.0"}


def test_a_foreign_namespace_is_refused_and_nothing_else_of_the_commit_is_applied(
    world: World, neighbour: Domain, slip_in: SlipIn
) -> None:
    """The services keep running; the generator removes the foreign file with the next demand."""
    domain, untouched = world.domain, neighbour.inventory()
    world.step(1, expected.after(1))
    slip_in(config("foreign", NEIGHBOUR), config("own", domain.namespace))
    domain.wait_refused(f'in the namespace "{NEIGHBOUR}"')
    assert domain.lines() == expected.after(1)
    assert neighbour.inventory() == untouched
    world.step(2, expected.after(2))
    assert neighbour.inventory() == untouched


def release(**spec: Any) -> Manifest:
    spec = {"interval": "10m", "chartRef": CHART, "targetNamespace": NEIGHBOUR, **spec}
    return build_manifest(
        "helm.toolkit.fluxcd.io/v2", "HelmRelease", "foreign", "perception", spec=spec
    )


KUSTOMIZATION = build_manifest(
    "kustomize.toolkit.fluxcd.io/v1",
    "Kustomization",
    "foreign",
    "perception",
    spec={
        "interval": "10m",
        "path": "./clusters",
        "prune": True,
        "sourceRef": {"kind": "GitRepository", "name": "demandops"},
        "targetNamespace": NEIGHBOUR,
    },
)
INTO_ITS_OWN = release(
    serviceAccountName="demandops",
    targetNamespace="perception",
    chartRef={**CHART, "namespace": NEIGHBOUR},
)
WAYS_AROUND = {
    "release elsewhere": (release(serviceAccountName="demandops"), "forbidden"),
    "release that names no account": (release(), "forbidden"),
    "release of another account": (release(serviceAccountName="default"), "forbidden"),
    "Kustomization that names no account": (KUSTOMIZATION, "forbidden"),
    "rights everywhere": (binding("ClusterRoleBinding"), "forbidden"),
    "more rights at home": (binding("RoleBinding", "perception"), "forbidden"),
    "rights at the neighbour's": (binding("RoleBinding", NEIGHBOUR), "forbidden"),
    "a neighbour's chart": (INTO_ITS_OWN, "cross-namespace references are not allowed"),
}


@pytest.mark.parametrize("way", WAYS_AROUND)
def test_no_way_around_the_account(
    world: World, neighbour: Domain, slip_in: SlipIn, way: str
) -> None:
    manifest, reason = WAYS_AROUND[way]
    domain, untouched, here = world.domain, neighbour.inventory(), world.domain.inventory()
    slip_in(manifest)
    domain.wait_refused(reason, "foreign")
    assert neighbour.inventory() == untouched
    withdraw(world)
    domain.wait_inventory(here)
    assert neighbour.inventory() == untouched


def test_a_base_is_not_fetched_from_elsewhere(
    world: World, rig: Rig, slip_in: SlipIn, tmp_path: Path
) -> None:
    domain, here, name = world.domain, world.domain.inventory(), f"elsewhere-{world.name}"
    base = {"resources": ["foreign.yaml"]}
    files = {"kustomization.yaml": base, "foreign.yaml": config("foreign", domain.namespace)}
    Clone(rig.push_url(name), tmp_path / "elsewhere").push(
        {file: json.dumps(content) for file, content in files.items()}
    )
    slip_in({"resources": [f"{rig.git_url(name)}?ref=main"]}, file=BASE)
    domain.wait_refused("fs-security-constraint")
    assert domain.inventory() == here


def test_the_cluster_refuses_pods_that_the_domain_may_not_have(world: World) -> None:
    """The cluster refuses even an administrator's pods, whatever kind of object makes them."""
    kube = world.domain.kube
    told = {
        (name, maker["kind"]): kube.refusal(maker)
        for name, (spec, _) in FORBIDDEN.items()
        for maker in makers(spec)
    }
    assert {key: text for key, text in told.items() if FORBIDDEN[key[0]][1] not in text} == {}
    taken = {name: [kube.refusal(one) for one in makers(spec)] for name, spec in ALLOWED.items()}
    assert {name: told for name, told in taken.items() if any(told)} == {}


def test_what_the_cluster_refuses_of_a_commit_is_reported(world: World, slip_in: SlipIn) -> None:
    deployment, reason = privileged_deployment()
    slip_in(deployment)
    world.domain.wait_refused(reason)
    withdraw(world)
    assert world.domain.kube.get("Deployment", "foreign", world.domain.namespace) is None


def test_the_hosts_network_is_refused_once_the_policy_forbids_it(world: World) -> None:
    """The operator must apply the bootstrap file, because it brings the policy to the cluster."""
    domain = world.domain
    nodes = world.file(NODES).replace("    type:", "    hostNetwork: false\n    type:")
    policy = world.file(POLICY).replace("podSecurity: host-network", "podSecurity: baseline")
    world.push({NODES: nodes, POLICY: policy})
    sent = world.demand(expected.demand(2))  # booked or not, this makes the generator fetch
    assert "podSecurity: baseline" in world.file(f"bootstrap/{CLUSTER}.yaml")
    world.apply(domain.kube, world.manifests(CLUSTER))
    alone, *others = makers(pod(hostNetwork=True))
    why = "hostNetwork is not possible with podSecurity: baseline of access domain 'perception'"
    domain.kube.wait("the refusal", lambda: all(why in domain.kube.refusal(one) for one in others))
    assert "violates PodSecurity" in domain.kube.refusal(alone)
    assert [domain.kube.refusal(one) for one in makers(pod())] == [""] * (len(others) + 1)
    domain.wake()
    domain.wait_applied(sent.commit)
    domain.wait_releases()
    for deployment in domain.find("Deployment"):
        assert "hostNetwork" not in deployment["spec"]["template"]["spec"]
