"""A commit to an access domain's folder changes only the domain's own namespace.

Each case commits to the folder what a careless person or an attacker might commit.
"""

from __future__ import annotations

import json
from collections.abc import Iterator

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
    config,
    makers,
    pod,
    withdraw,
)
from tests.e2e.common.world import World
from tests.e2e.conftest import MakeWorld, SlipIn
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.components import ARGOCD as CONTROL
from tests.e2e.rig.kube import build_manifest
from tests.kit import plain_yaml

NODES, POLICY = "inventory/nodes.yaml", "policy/access-domains.yaml"
ARGOCD = "argoproj.io/v1alpha1"
TABLES = plain_yaml.beside(__file__)


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


@pytest.mark.parametrize("name", TABLES["refused"])
def test_it_is_refused_and_services_run_on(
    world: World, neighbour: Domain, slip_in: SlipIn, name: str
) -> None:
    manifest, reason = TABLES["refused"][name].values()
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


@pytest.mark.only("flux", "objects of Flux; an object of Argo CD names a project instead")
@pytest.mark.parametrize("way", TABLES["ways around"])
def test_no_way_around_the_account(
    world: World, neighbour: Domain, slip_in: SlipIn, way: str
) -> None:
    manifest, reason = TABLES["ways around"][way].values()
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


@pytest.mark.only("argocd", "a release of Flux has an account, but no project")
@pytest.mark.parametrize("release", TABLES["releases"])
def test_a_release_cannot_leave_its_namespace(
    world: World, slip_in: SlipIn, unlimited_project: None, release: str
) -> None:
    kind, project, namespace, reason = TABLES["releases"][release]
    domain, spec = world.domain, {}
    if project:
        spec = {"project": project, **TABLES["application"]}
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
