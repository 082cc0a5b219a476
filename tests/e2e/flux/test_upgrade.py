"""The state repo goes over to Argo CD while this cluster's Flux was not suspended: all runs on.

`demandops upgrade` prints what to do before; a cluster that was out of reach could not be told.
"""

from __future__ import annotations

from tests.e2e.common import expected
from tests.e2e.common.staterepo import demandops

from .world import World


def test_a_flux_that_was_not_suspended_fails_and_leaves_alone_what_runs(world: World) -> None:
    domain = world.domain
    world.step(1, expected.after(1))
    domain.wait_releases()
    before = domain.pods()
    assert before

    demandops(world.folder, "upgrade", "--state-repo", world.push_url, "--gitops", "argocd")
    domain.wake()
    domain.wait_attempted(world.tip())
    domain.kube.wait(  # a trouble that is tried again is none for a moment
        "Flux to fail at the Applications",
        lambda: "Application" in domain.trouble("Kustomization", domain.name),
    )
    assert domain.pods() == before
    assert len(domain.find("HelmRelease")) == 3

    demandops(world.folder, "upgrade", "--state-repo", world.push_url, "--gitops", "flux")
    domain.wake()
    domain.wait_applied(world.tip())
    assert domain.pods() == before
    for step in (2, 3):
        world.step(step, expected.after(step))
