"""A state repo of the second version is upgraded while its services run."""

from __future__ import annotations

from pathlib import Path

from tests.e2e.common.expected import CLUSTER, NAMESPACE
from tests.e2e.common.world import demandops
from tests.e2e.conftest import MakeWorld
from tests.e2e.rig.cluster import Rig
from tests.kit.repo import git

from .view import Domain

BUNDLE = Path(__file__).parents[2] / "fixtures" / "second-version" / "state.bundle"
RECORDER = "rec-edge-recorder-62dc17457446"
TWICE = "mqtt-vehicle01-edge-"
"""The clients of a connection whose only route an older connection carries too."""


def test_an_upgrade_from_the_second_version_restarts_nothing_that_stays(
    make_world: MakeWorld, rig: Rig, tmp_path: Path
) -> None:
    world = make_world()
    git(tmp_path, "clone", "--quiet", "--bare", str(BUNDLE), "second.git")
    before_faults = "before-faults^{commit}:refs/heads/main"
    git(tmp_path / "second.git", "push", "--quiet", "--force", world.push_url, before_faults)
    world.person.git("fetch", "--quiet", "origin", "main")
    world.person.git("reset", "--quiet", "--hard", "FETCH_HEAD")
    manifests = world.manifests(CLUSTER)
    for item in manifests:
        if item["kind"] == "GitRepository":
            item["spec"]["url"] = rig.git_url(world.name)
    world.apply(rig.kube, manifests)
    world.domains = {domain.namespace: domain for domain in Domain.all_in(rig.kube, manifests)}
    domain = world.domains[NAMESPACE]
    domain.settle(world.tip())
    domain.wait_releases()
    before = domain.uids()
    assert [name for name in before if name.startswith(TWICE)]

    demandops(world.folder, "upgrade", "--state-repo", world.push_url)
    domain.wake()
    domain.wait_applied(world.tip())
    domain.wait_releases()
    after = domain.uids()
    assert after.keys() == {name for name in before if not name.startswith(TWICE)}
    # one service had kept replicas that nobody demands: it has fewer pods now, or soon
    assert after.pop(RECORDER)[0] == before[RECORDER][0]
    assert {name: before[name] for name in after} == after
    demandops(world.folder, "verify", "--state-repo", world.push_url, "HEAD~1..")
