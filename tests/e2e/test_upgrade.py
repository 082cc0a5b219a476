"""A state repo is rendered anew, for another controller or by a newer version, and all runs on."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.common import expected
from tests.e2e.common.expected import CLUSTER, NAMESPACE
from tests.e2e.common.world import World
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Gitops, Rig
from tests.kit.repo import git

SECOND = Path(__file__).parents[1] / "fixtures" / "second-version" / "state.bundle"
RECORDER = "rec-edge-recorder-62dc17457446"
TWICE = "mqtt-vehicle01-edge-"
"""The clients of a connection whose only route an older connection carries too."""
OTHER: dict[Gitops, tuple[Gitops, str]] = {
    "flux": ("argocd", "Application"),
    "argocd": ("flux", "HelmRelease"),
}


def test_a_controller_that_was_not_retired_fails_and_changes_no_pod(
    world: World, gitops: Gitops
) -> None:
    """The state repo moves to the other controller while the cluster still runs the former one.

    docs/argocd.md says how to retire the former controller first. An operator cannot do so on a
    cluster that cannot be reached.
    """
    domain, (other, foreign) = world.domain, OTHER[gitops]
    world.step(1, expected.after(1))
    domain.wait_releases()
    before, releases = domain.uids(), domain.releases()
    assert before
    assert len(releases) == 3

    world.upgrade(other)
    domain.wake()
    domain.wait_attempted(world.tip())
    domain.wait_refused(foreign)
    assert domain.uids() == before
    assert domain.releases() == releases

    domain.follow(world.upgrade(gitops))
    assert domain.uids() == before
    for step in (2, 3):
        world.step(step, expected.after(step))


@pytest.mark.only("flux", "the second version's state repo is for Flux")
def test_an_upgrade_from_the_second_version_restarts_nothing_that_stays(
    make_world: MakeWorld, rig: Rig, tmp_path: Path
) -> None:
    world = make_world()
    git(tmp_path, "clone", "--quiet", "--bare", str(SECOND), "second.git")
    left = "before-faults^{commit}:refs/heads/main"
    git(tmp_path / "second.git", "push", "--quiet", "--force", world.url, left)
    manifests = world.manifests(CLUSTER)
    for item in manifests:
        if item["kind"] == "GitRepository":
            item["spec"]["url"] = world.url
    world.domains = {domain.namespace: domain for domain in world.lay_down(rig, manifests)}
    domain = world.domains[NAMESPACE]
    domain.settle(world.tip())
    domain.wait_releases()
    before = domain.uids()
    assert [name for name in before if name.startswith(TWICE)]

    domain.follow(world.upgrade())
    domain.wait_releases()
    after = domain.uids()
    assert after.keys() == {name for name in before if not name.startswith(TWICE)}
    # one service had kept replicas that nobody demands: it has fewer pods now, or soon
    assert after.pop(RECORDER)[0] == before[RECORDER][0]
    assert {name: before[name] for name in after} == after
    world.demandops("verify", "HEAD~1..")
