"""An access domain's service account can change only the domain's own namespace.

Each case commits to the domain's folder what a careless person or an attacker might commit.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.e2e.common import expected
from tests.e2e.common.intrusion import ALLOWED, FILE, FORBIDDEN, NEIGHBOUR, binding, makers, pod
from tests.e2e.rig.clone import Clone
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.kube import build_manifest

from .view import Domain
from .world import World

NODES, POLICY = "inventory/nodes.yaml", "policy/access-domains.yaml"
BASE = "clusters/c-its/perception/foreign/kustomization.yaml"


@pytest.fixture(scope="module")
def neighbour(rig: Rig) -> Iterator[Domain]:
    rig.kube.apply({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NEIGHBOUR}})
    domain = Domain(rig.kube, NEIGHBOUR, "none")
    # Kubernetes creates the service account and the ConfigMap
    rig.kube.wait("the account", lambda: rig.kube.get("ServiceAccount", "default", NEIGHBOUR))
    rig.kube.wait("the root", lambda: rig.kube.get("ConfigMap", "kube-root-ca.crt", NEIGHBOUR))
    yield domain
    rig.kube.delete("Namespace", NEIGHBOUR)


SlipIn = Callable[..., None]


@pytest.fixture
def slip_in(world: World, neighbour: Domain) -> Iterator[SlipIn]:
    """Return a function that commits manifests to the domain's folder.

    The function waits until Flux has tried to apply the manifests. The fixture removes the
    manifests after the test.
    """

    def push(*manifests: dict[str, Any], file: str = FILE) -> None:
        text = "\n---\n".join(json.dumps(manifest) for manifest in manifests)
        commit = world.push({file: text})
        world.domain.wake()
        world.domain.wait_attempted(commit)

    yield push
    remove_committed(world)


def remove_committed(world: World) -> None:
    """Remove the committed files that still exist, and wait until Flux has applied the removal."""
    commit = world.tip()
    if there := {FILE, BASE} & set(world.person.git("ls-files").split()):
        commit = world.push(dict.fromkeys(there))
    world.domain.wake()
    world.domain.wait_applied(commit)


def test_a_foreign_namespace_is_refused_and_nothing_else_of_the_commit_is_applied(
    world: World, neighbour: Domain, slip_in: SlipIn
) -> None:
    """The services keep running; the generator removes the foreign file with the next demand."""
    domain, untouched = world.domain, neighbour.inventory()
    world.step(1, expected.after(1))
    slip_in(config("foreign", NEIGHBOUR), config("own", domain.namespace))
    wait_refused(domain, f'in the namespace "{NEIGHBOUR}"')
    assert domain.lines() == expected.after(1)
    assert neighbour.inventory() == untouched
    world.step(2, expected.after(2))
    assert neighbour.inventory() == untouched


def config(name: str, namespace: str) -> dict[str, Any]:
    return build_manifest("v1", "ConfigMap", name, namespace, data={"made": "by hand"})


def release(**spec: Any) -> dict[str, Any]:
    """Return a HelmRelease of the detection's chart that targets the neighbour's namespace."""
    chart = {"kind": "HelmChart", "name": "object-detection-0.1.0"}
    spec = {"interval": "10m", "chartRef": chart, "targetNamespace": NEIGHBOUR, **spec}
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


@pytest.mark.parametrize(
    "manifest",
    [
        pytest.param(release(serviceAccountName="demandops"), id="release elsewhere"),
        pytest.param(release(), id="release that names no account"),
        pytest.param(release(serviceAccountName="default"), id="release of another account"),
        pytest.param(KUSTOMIZATION, id="Kustomization that names no account"),
        pytest.param(binding("ClusterRoleBinding"), id="rights everywhere"),
        pytest.param(binding("RoleBinding", "perception"), id="more rights at home"),
        pytest.param(binding("RoleBinding", NEIGHBOUR), id="rights at the neighbour's"),
    ],
)
def test_no_way_around_the_account(
    world: World, neighbour: Domain, slip_in: SlipIn, manifest: dict[str, Any]
) -> None:
    domain, untouched, here = world.domain, neighbour.inventory(), world.domain.inventory()
    slip_in(manifest)
    wait_refused(domain, "forbidden", manifest)
    assert neighbour.inventory() == untouched
    remove_committed(world)
    domain.wait_inventory(here)
    assert neighbour.inventory() == untouched


def test_a_reference_does_not_leave_the_namespace(
    world: World, neighbour: Domain, slip_in: SlipIn
) -> None:
    domain, here = world.domain, world.domain.inventory()
    chart = {"kind": "HelmChart", "name": "object-detection-0.1.0", "namespace": NEIGHBOUR}
    manifest = release(
        serviceAccountName="demandops", targetNamespace=domain.namespace, chartRef=chart
    )
    slip_in(manifest)
    wait_refused(domain, "cross-namespace references are not allowed", manifest)
    remove_committed(world)
    domain.wait_inventory(here)


def test_a_base_is_not_fetched_from_elsewhere(
    world: World, rig: Rig, neighbour: Domain, slip_in: SlipIn, tmp_path: Path
) -> None:
    domain, here, name = world.domain, world.domain.inventory(), f"elsewhere-{world.name}"
    base = {"resources": ["foreign.yaml"]}
    files = {"kustomization.yaml": base, "foreign.yaml": config("foreign", domain.namespace)}
    Clone(rig.push_url(name), tmp_path / "elsewhere").push(
        {file: json.dumps(content) for file, content in files.items()}
    )
    slip_in({"resources": [f"{rig.git_url(name)}?ref=main"]}, file=BASE)
    wait_refused(domain, "fs-security-constraint")
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
    spec, reason = FORBIDDEN["privileged"]
    (deployment,) = (maker for maker in makers(spec) if maker["kind"] == "Deployment")
    slip_in(deployment)
    wait_refused(world.domain, reason)
    remove_committed(world)
    assert world.domain.kube.get("Deployment", "foreign", world.domain.namespace) is None


def test_the_hosts_network_is_refused_once_the_policy_forbids_it(world: World) -> None:
    """The operator must apply the bootstrap file, because it brings the policy to the cluster."""
    domain = world.domain
    nodes = world.file(NODES).replace("    type:", "    hostNetwork: false\n    type:")
    policy = world.file(POLICY).replace("podSecurity: host-network", "podSecurity: baseline")
    world.push({NODES: nodes, POLICY: policy})
    sent = world.demand(expected.demand(2))  # booked or not, this makes the generator fetch
    bootstrap = world.file("bootstrap/c-its.yaml")
    assert "podSecurity: baseline" in bootstrap
    world.apply(domain.kube, list(yaml.safe_load_all(bootstrap)))
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


def wait_refused(domain: Domain, why: str, manifest: dict[str, Any] | None = None) -> None:
    """Wait until the Kustomization reports a refusal; a HelmRelease's own report counts too."""
    objects = [("Kustomization", domain.name)]
    if manifest is not None and manifest["kind"] == "HelmRelease":
        objects.append(("HelmRelease", manifest["metadata"]["name"]))

    def refused() -> bool:
        return any(why in domain.trouble(kind, name) for kind, name in objects)

    domain.kube.wait(f"'{why}' to be reported", refused)
