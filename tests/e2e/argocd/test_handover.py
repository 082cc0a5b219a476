"""A state repo moves from Flux to Argo CD and back as docs/argocd.md says, and no pod restarts."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from tests.e2e.common import expected
from tests.e2e.common.expected import CLUSTER, NODES, WITHOUT_DEMANDS
from tests.e2e.common.namespace import name_of
from tests.e2e.common.ros import Client
from tests.e2e.common.world import World, demandops, running
from tests.e2e.flux.view import Domain as FluxDomain
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.components import ARGOCD as CONTROL
from tests.e2e.rig.tools import Report

from .view import Domain

FLUX_KINDS = ("HelmRelease", "Kustomization", "HelmChart", "GitRepository")
SUSPENDED = {"spec": {"suspend": True}}


@pytest.fixture(scope="module")
def both(request: pytest.FixtureRequest, say: Report) -> Iterator[Rig]:
    rig = Rig("both", gitops="flux", beside="argocd", nodes=NODES, report=say)
    with running(rig, request.session):
        yield rig


def test_every_pod_stays_there_and_back(
    both: Rig, client: Client, ros_domain: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    world = World(both, tmp_path_factory.mktemp("world"), ros_domain, client)
    try:
        flux = world.bootstrap(CLUSTER, both)
        world.generator.start()
        flux.wait_lines(WITHOUT_DEMANDS)
        world.step(1, expected.after(1))
        flux.wait_releases()
        before = flux.uids()

        from_flux(flux)
        argocd = to_argocd(world)
        argocd.wait_lines(expected.after(2))
        forget_flux(flux)
        assert {name: argocd.uids()[name] for name in before} == before
        sent = world.demand(expected.demand(3))
        argocd.wake()
        argocd.wait_applied(sent.commit)
        argocd.wait_lines(expected.after(3))
        argocd.wait_releases()

        before = argocd.uids()
        forget_argocd(argocd)
        to_flux(world)
        flux.wait_lines(expected.after(4))
        flux.wait_releases()
        assert {name: flux.uids()[name] for name in before} == before
        for step in (5, 6, 7, 8):
            world.step(step, expected.after(step))
    finally:
        world.generator.stop()
        world.remove_wide()


def from_flux(domain: FluxDomain) -> None:
    for kind in ("Kustomization", "HelmRelease"):
        for item in domain.find(kind):
            domain.kube.patch(kind, name_of(item), SUSPENDED, domain.namespace)


def upgrade(world: World, gitops: str) -> str:
    """Render the state repo anew while the generator runs; return the only commit of this."""
    before = world.tip()
    options = ("--gitops", gitops, "--output", "json")
    output = demandops(world.folder, "upgrade", "--state-repo", world.push_url, *options)
    assert world.commits_since(before) == 1
    commit = json.loads(output)["commit"]
    assert commit == world.tip()
    return str(commit)


def to_argocd(world: World) -> Domain:
    upgraded = upgrade(world, "argocd")
    manifests = world.manifests(CLUSTER)
    world.apply(world.rig.kube, manifests)
    (domain,) = Domain.all_in(world.rig.kube, manifests)
    domain.wait_applied(upgraded)
    domain.wait_releases()
    sent = world.demand(expected.demand(2))
    domain.wake()
    domain.wait_applied(sent.commit)
    domain.wait_releases()
    return domain


def forget_flux(domain: FluxDomain) -> None:
    """Delete Helm's records and Flux's objects; as these are suspended, no release goes."""
    for kind in FLUX_KINDS:
        for item in domain.find(kind):
            domain.take_away(kind, name_of(item))
    for secret in domain.find("Secret"):
        if secret["type"] == "helm.sh/release.v1":
            domain.kube.delete("Secret", name_of(secret), domain.namespace)


def forget_argocd(domain: Domain) -> None:
    """Delete the Applications, but not the objects that they manage.

    The folder's Application goes first, because it would restore the Applications of the releases.
    """
    apps = [(domain.name, CONTROL), *((name, domain.namespace) for name in domain.releases())]
    for name, namespace in apps:
        domain.kube.patch("Application", name, {"metadata": {"finalizers": None}}, namespace)
        domain.kube.delete("Application", name, namespace)
        domain.kube.wait_gone("Application", name, namespace)
    domain.kube.delete("AppProject", domain.name, CONTROL)


def to_flux(world: World) -> None:
    upgrade(world, "flux")
    world.demand(expected.demand(4))
    world.bootstrap(CLUSTER, world.rig)
