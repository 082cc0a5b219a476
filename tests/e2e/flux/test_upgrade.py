"""The state repo moves to Argo CD, but this cluster's Flux was not suspended: all services run on.

`demandops upgrade` prints what to do before, which is impossible on an unreachable cluster.
"""

from __future__ import annotations

from tests.e2e.common import expected
from tests.e2e.common.staterepo import demandops

from .world import World


def test_a_flux_that_was_not_suspended_fails_and_changes_no_pod(world: World) -> None:
    domain = world.domain
    world.step(1, expected.after(1))
    domain.wait_releases()
    before = domain.pods()
    assert before

    demandops(world.folder, "upgrade", "--state-repo", world.push_url, "--gitops", "argocd")
    domain.wake()
    domain.wait_attempted(world.tip())
    domain.kube.wait(  # a retry clears the error for a moment
        "Flux to fail on the Applications",
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
