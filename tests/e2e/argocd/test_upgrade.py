"""The state repo moves to Flux, but this cluster's Argo CD was not removed: all services run on.

`demandops upgrade` prints what to do before, which is impossible on an unreachable cluster.
"""

from __future__ import annotations

from tests.e2e.common import expected
from tests.e2e.common.staterepo import demandops
from tests.e2e.rig.argocd import NAMESPACE

from .world import World


def test_an_argo_cd_that_was_not_removed_fails_and_changes_no_pod(world: World) -> None:
    domain = world.domain
    world.step(1, expected.after(1))
    domain.wait_releases()
    before, releases = domain.pods(), domain.releases()
    assert before
    assert len(releases) == 3

    demandops(world.folder, "upgrade", "--state-repo", world.push_url, "--gitops", "flux")
    domain.wake()
    domain.wait_fetched(world.tip())
    domain.kube.wait(  # a retry clears the error for a moment
        "Argo CD to fail on the HelmReleases",
        lambda: "HelmRelease" in domain.trouble(domain.name, NAMESPACE),
    )
    assert domain.pods() == before
    assert domain.releases() == releases

    demandops(world.folder, "upgrade", "--state-repo", world.push_url, "--gitops", "argocd")
    domain.wake()
    domain.wait_applied(world.tip())
    assert domain.pods() == before
    for step in (2, 3):
        world.step(step, expected.after(step))
