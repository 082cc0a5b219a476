"""A commit to an access domain's folder changes only the domain's own namespace.

Each case commits to the folder what a careless person or an attacker might commit.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.e2e.common import expected
from tests.e2e.common.domain import Domain
from tests.e2e.common.expected import CLUSTER
from tests.e2e.common.intrusion import (
    ALLOWED,
    BASE,
    ELSEWHERE,
    FORBIDDEN,
    NEIGHBOUR,
    binding,
    config,
    makers,
    pod,
    withdraw,
)
from tests.e2e.common.world import World
from tests.e2e.conftest import MakeWorld, SlipIn
from tests.e2e.rig.cluster import Gitops, Rig
from tests.e2e.rig.components import ARGOCD as CONTROL
from tests.e2e.rig.kube import Manifest, build_manifest

NODES, POLICY = "inventory/nodes.yaml", "policy/access-domains.yaml"
ARGOCD = "argoproj.io/v1alpha1"
CHART = {"kind": "HelmChart", "name": "object-detection-0.1.0"}


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    """A state repo whose services of the first step run."""
    made = make_world()
    made.begin(rig)
    made.step(1, expected.after(1))
    return made


def test_a_foreign_namespace_is_refused_and_nothing_else_of_the_commit_is_applied(
    world: World, neighbour: Domain, slip_in: SlipIn
) -> None:
    """The services keep running; the generator removes the foreign file with the next demand."""
    domain, untouched = world.domain, neighbour.inventory()
    before = domain.lines()
    slip_in(config("foreign", NEIGHBOUR), config("own", domain.namespace))
    where = {"flux": f'in the namespace "{NEIGHBOUR}"', "argocd": f"namespace {NEIGHBOUR} is not"}
    domain.wait_refused(where[world.rig.gitops])
    assert domain.lines() == before
    assert neighbour.inventory() == untouched
    world.step(2, expected.after(2))
    assert neighbour.inventory() == untouched


PRIVILEGED, BY_POLICY = FORBIDDEN["privileged"]
REFUSED: dict[str, tuple[Manifest, dict[Gitops, str]]] = {
    "a kind of the whole cluster": (
        build_manifest("v1", "Namespace", "foreign"),
        {"flux": "forbidden", "argocd": "resource :Namespace is not permitted in project"},
    ),
    "rights everywhere": (
        binding("ClusterRoleBinding"),
        {"flux": "forbidden", "argocd": "ClusterRoleBinding is not permitted in project"},
    ),
    "rights at the neighbour's": (
        binding("RoleBinding", NEIGHBOUR),
        {"flux": "forbidden", "argocd": f"namespace {NEIGHBOUR} is not permitted in project"},
    ),
    "more rights at home": (
        binding("RoleBinding", "perception"),
        {"flux": "forbidden", "argocd": "attempting to grant RBAC permissions not currently held"},
    ),
    "a kind that the domain may not have": (
        build_manifest("apps/v1", "DaemonSet", "foreign", "perception", spec={}),
        {"flux": "forbidden", "argocd": "resource apps:DaemonSet is not permitted in project"},
    ),
    "a privileged pod": (
        next(maker for maker in makers(PRIVILEGED) if maker["kind"] == "Deployment"),
        {"flux": BY_POLICY, "argocd": BY_POLICY},
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_and_services_run_on(
    world: World, neighbour: Domain, slip_in: SlipIn, name: str
) -> None:
    manifest, reason = REFUSED[name]
    domain, untouched, before = world.domain, neighbour.inventory(), world.domain.lines()
    slip_in(manifest)
    domain.wait_refused(reason[world.rig.gitops])
    assert domain.lines() == before
    assert neighbour.inventory() == untouched
    metadata = manifest["metadata"]
    place = (metadata["name"], metadata.get("namespace", ""), manifest["apiVersion"])
    assert domain.kube.get(manifest["kind"], *place) is None
    withdraw(world)
    assert domain.lines() == before


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
    "a neighbour's chart": (INTO_ITS_OWN, "cross-namespace references are not allowed"),
}


@pytest.mark.only("flux", "objects of Flux; an object of Argo CD names a project instead")
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


@pytest.mark.only("flux", "only Flux's folder is a Kustomization, which may name bases")
def test_a_base_is_not_fetched_from_elsewhere(world: World, slip_in: SlipIn) -> None:
    """The base is fetched as one of another repository would be: by its URL."""
    domain, here = world.domain, world.domain.inventory()
    base = {"resources": ["foreign.yaml"]}
    files = {"kustomization.yaml": base, "foreign.yaml": config("foreign", domain.namespace)}
    world.push({f"{ELSEWHERE}/{file}": json.dumps(content) for file, content in files.items()})
    url = f"{world.url}//{ELSEWHERE}?ref=main"
    slip_in({"resources": [url]}, file=BASE)
    domain.wait_refused("fs-security-constraint")
    assert domain.inventory() == here


@pytest.fixture(scope="module")
def unlimited_project(rig: Rig) -> Iterator[None]:
    """Make Argo CD's unlimited project `default`, which each installation of Argo CD has."""
    anywhere = {"server": "*", "namespace": "*"}
    spec = {
        "sourceRepos": ["*"],
        "destinations": [anywhere],
        "destinationServiceAccounts": [{**anywhere, "defaultServiceAccount": "default"}],
        "clusterResourceWhitelist": [{"group": "*", "kind": "*"}],
    }
    rig.kube.apply(build_manifest(ARGOCD, "AppProject", "default", CONTROL, spec=spec))
    yield
    rig.kube.delete("AppProject", "default", CONTROL)


APPLICATION = {
    "source": {
        "path": "appdefs/object-detection-fusion/charts/object-detection",
        "targetRevision": "main",
    },
    "destination": {"server": "https://kubernetes.default.svc", "namespace": NEIGHBOUR},
    "syncPolicy": {"automated": {}},
}


@pytest.mark.only("argocd", "a release of Flux has an account, but no project")
@pytest.mark.parametrize(
    ("kind", "project", "namespace", "reason"),
    [
        ("Application", "default", "perception", "to use project"),
        ("Application", "demandops-perception", "perception", "do not match"),
        ("Application", "default", CONTROL, "namespace argocd is not permitted"),
        ("AppProject", None, "perception", "AppProject is not permitted in project"),
    ],
    ids=["another project", "another namespace", "in Argo CD's own namespace", "a project"],
)
def test_a_release_cannot_leave_its_namespace(
    world: World,
    slip_in: SlipIn,
    unlimited_project: None,
    kind: str,
    project: str | None,
    namespace: str,
    reason: str,
) -> None:
    domain, spec = world.domain, {}
    if project:
        spec = {"project": project, **APPLICATION}
        spec["source"] = spec["source"] | {"repoURL": world.url}
    slip_in(build_manifest(ARGOCD, kind, "foreign", namespace, spec=spec))
    domain.wait_refused(reason, "foreign")
    assert domain.kube.get(kind, "foreign", CONTROL) is None
    assert domain.kube.find("Deployment", NEIGHBOUR) == []


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


def test_the_hosts_network_is_refused_once_the_policy_forbids_it(world: World) -> None:
    """The operator must apply the bootstrap file, because it brings the policy to the cluster."""
    domain = world.domain
    nodes = world.file(NODES).replace("    type:", "    hostNetwork: false\n    type:")
    policy = world.file(POLICY).replace("podSecurity: host-network", "podSecurity: baseline")
    world.push({NODES: nodes, POLICY: policy})
    sent = world.demand(expected.demand(2))  # booked or not, this makes the generator fetch
    assert "podSecurity: baseline" in world.file(f"bootstrap/{CLUSTER}.yaml")
    world.lay_down(world.rig, world.manifests(CLUSTER))
    alone, *others = makers(pod(hostNetwork=True))
    why = "hostNetwork is not possible with podSecurity: baseline of access domain 'perception'"
    domain.kube.wait("the refusal", lambda: all(why in domain.kube.refusal(one) for one in others))
    assert "violates PodSecurity" in domain.kube.refusal(alone)
    assert [domain.kube.refusal(one) for one in makers(pod())] == [""] * (len(others) + 1)
    domain.follow(sent.commit)

    def host_network() -> list[str]:
        deployments = domain.names("Deployment")
        return [one for one in deployments if "hostNetwork" in domain.pod_template(one)["spec"]]

    domain.wait("the pods to leave the host's network", lambda: host_network() == [])
