"""A state repo moves from Flux to Argo CD and back as docs/argocd.md says, and no pod restarts."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.common import expected
from tests.e2e.common.argocd import ArgoDomain
from tests.e2e.common.domain import name_of
from tests.e2e.common.expected import CLUSTER, NODES
from tests.e2e.common.flux import FluxDomain
from tests.e2e.common.world import World
from tests.e2e.rig.cluster import Gitops, Rig
from tests.e2e.rig.components import ARGOCD as CONTROL
from tests.e2e.rig.tools import Report
from tests.kit.ros import Client

SUSPENDED = {"spec": {"suspend": True}}


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory, say: Report) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("rig")
    with Rig("both", folder, beside="argocd", nodes=NODES, report=say) as rig:
        yield rig


@pytest.mark.argocd
def test_every_pod_stays_there_and_back(
    both: Rig, client: Client, ros_domain: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    world = World(both, tmp_path_factory.mktemp("world"), ros_domain, client)
    try:
        world.begin(both)
        flux = world.domain
        world.step(1, expected.after(1))
        flux.wait_releases()
        before = flux.uids()

        for kind in ("Kustomization", "HelmRelease"):
            for name in flux.names(kind):
                flux.kube.patch(kind, name, SUSPENDED, flux.namespace)
        upgraded = upgrade(world, "argocd")
        (argocd,) = world.lay_down(both, world.manifests(CLUSTER))
        world.domains[CLUSTER] = argocd
        argocd.wait_applied(upgraded)
        argocd.wait_releases()
        world.step(2, expected.after(2))
        argocd.wait_releases()
        forget_flux(flux)
        assert before.items() <= argocd.uids().items()
        world.step(3, expected.after(3))
        argocd.wait_releases()

        before = argocd.uids()
        forget_argocd(argocd)
        upgrade(world, "flux")
        world.demand(expected.demand(4))
        flux = world.bootstrap(CLUSTER, both)
        flux.wait_lines(expected.after(4))
        flux.wait_releases()
        assert before.items() <= flux.uids().items()
        for step in (5, 6, 7, 8):
            world.step(step, expected.after(step))
    finally:
        world.domains.clear()  # the cluster goes as a whole
        world.remove()


def upgrade(world: World, gitops: Gitops) -> str:
    """Render the state repo anew while the generator runs; return the only commit of this."""
    before = world.tip()
    world.upgrade(gitops)
    assert world.commits_since(before) == 1
    return world.tip()


def forget_flux(domain: FluxDomain) -> None:
    """Delete Helm's records and Flux's objects; as these are suspended, no release goes."""
    for kind in ("HelmRelease", "Kustomization", "HelmChart", "GitRepository"):
        for name in domain.names(kind):
            domain.take_away(kind, name)
    for secret in domain.find("Secret"):
        if secret["type"] == "helm.sh/release.v1":
            domain.kube.delete("Secret", name_of(secret), domain.namespace)


def forget_argocd(domain: ArgoDomain) -> None:
    """Delete the Applications, but not the objects that they manage.

    The folder's Application goes first, because it would restore the Applications of the releases.
    """
    apps = [(domain.name, CONTROL), *((name, domain.namespace) for name in domain.releases())]
    for name, namespace in apps:
        domain.kube.patch("Application", name, {"metadata": {"finalizers": None}}, namespace)
        domain.kube.delete("Application", name, namespace)
        domain.kube.wait_gone("Application", name, namespace)
    domain.kube.delete("AppProject", domain.name, CONTROL)
